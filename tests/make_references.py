"""Reference images of `scenes/*.xml`, rendered with Mitsuba's own integrators.

    python -m tests.make_references [NAME ...]

writes `tests/references/NAME.exr`, and `NAME-1.exr` for a second sensor. A file holds the means of
blocks of 8 x 8 pixels and, below them, their standard errors. The references do not depend on the
light tree: Mitsuba's `direct`, `path` or `volpath` renders them, or a replacement where `direct` is
wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from manylights import loading

from tests import statistics_tools as tools
from tests.exhaustive import make_exhaustive

SCENE_FOLDER = Path(__file__).parents[1] / "scenes"
REFERENCE_FOLDER = Path(__file__).parent / "references"
WIDTH, HEIGHT, BLOCK = 96, 64, 8
SEEDS = 32
SAMPLES = 256

BSDF_ONLY = {"mesh_attribute", "shapes", "many_bulbs"}
"""Scenes lit by nothing but meshes whose emission Mitsuba samples wrongly.

These are mesh attributes without texture coordinates, and smooth normals. BSDF sampling is right.
"""

WITHOUT_AREA_SAMPLING = {"curves"}
"""Scenes with shapes that `direct` refuses to sample, among other lights."""

WITHOUT_SYMBOLIC_CALLS = {"timed_sky"}
"""Scenes with emitters that need evaluated calls in `direct`."""

PATHS = {"interior": "path", "fog": "volpath", "glass_fog": "volpath", "heterogeneous": "volpath"}
"""Scenes with light after several bounces or in media, and the integrator of their references."""


def scene_names():
    """Names of all scenes."""
    return sorted(path.stem for path in SCENE_FOLDER.glob("*.xml"))


def load_scene(name, integrator="keep", sampler="keep"):
    """Load a scene with the size of the references, another integrator or sampler if named."""
    size = {"resx": str(WIDTH), "resy": str(HEIGHT)}
    path = str(SCENE_FOLDER / f"{name}.xml")
    return loading.load(path, size, integrator, sampler=sampler).scene


def load_without_area_lights(name):
    """Load a scene whose shapes do not shine."""
    path = SCENE_FOLDER / f"{name}.xml"
    root = ElementTree.parse(path).getroot()
    for shape in root.iter("shape"):
        for emitter in shape.findall("emitter"):
            shape.remove(emitter)
    for reference in root.iter("string"):
        if reference.get("name") == "filename":
            reference.set("value", str(path.parent / reference.get("value")))
    text = ElementTree.tostring(root, encoding="unicode")
    return mi.load_string(text, resx=WIDTH, resy=HEIGHT)


def blocks_of(images):
    """Means of the blocks: (seeds, rows, columns, 3); further channels are left out."""
    return tools.tile_means(images[..., :3], BLOCK)


def direct(**parameters):
    """Mitsuba's own integrator."""
    return mi.load_dict({"type": "direct", **parameters})


def rendered_blocks(scene, integrator, sensor):
    """Block means of one rendering per seed."""
    images = (
        tools.render_seeds(scene, integrator, SAMPLES, [seed], sensor) for seed in range(SEEDS)
    )
    return np.concatenate([blocks_of(image) for image in images])


def reference_blocks(name, sensor):
    """Block means of one reference rendering per seed."""
    if name in PATHS:
        return rendered_blocks(load_scene(name, PATHS[name]), None, sensor)
    if name in BSDF_ONLY:
        return rendered_blocks(load_scene(name), direct(emitter_samples=0), sensor)
    if name in WITHOUT_AREA_SAMPLING:
        # One after the other: a call of an emitter's method reaches those of all living scenes.
        emission = rendered_blocks(load_scene(name), make_exhaustive(emitter_samples=False), sensor)
        gc.collect()
        return emission + rendered_blocks(
            load_without_area_lights(name), direct(bsdf_samples=0), sensor
        )
    calls = dr.scoped_set_flag(dr.JitFlag.SymbolicCalls, False)
    with calls if name in WITHOUT_SYMBOLIC_CALLS else contextlib.nullcontext():
        return rendered_blocks(load_scene(name), direct(), sensor)


def reference_path(name, sensor):
    """File of a reference."""
    return REFERENCE_FOLDER / (f"{name}-{sensor}.exr" if sensor else f"{name}.exr")


def write_reference(path, blocks):
    """Store means and standard errors of block means (seeds, rows, columns, 3)."""
    variance, _ = tools.variance_of_mean(blocks)
    stacked = np.concatenate([blocks.mean(axis=0), np.sqrt(variance)]).astype(np.float32)
    path.parent.mkdir(exist_ok=True)
    mi.Bitmap(np.ascontiguousarray(stacked)).write(str(path))


def read_reference(path):
    """Means and standard errors of the blocks."""
    stacked = np.array(mi.Bitmap(str(path)), dtype=np.float64)
    return np.split(stacked, 2)


def main():
    """Render the references named on the command line, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="scenes (default: all)")
    names = parser.parse_args().names or scene_names()
    mi.set_variant("llvm_ad_rgb")
    for name in names:
        start = time.perf_counter()
        sensors = len(load_scene(name, PATHS.get(name, "keep")).sensors())
        for sensor in range(sensors):
            write_reference(reference_path(name, sensor), reference_blocks(name, sensor))
        print(f"{name}: {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()

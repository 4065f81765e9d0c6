"""Measure how long USD stages with very many lights take to load, their memory, and their render.

    python scenes/bench/usd_loading.py [NAME ...]          # spheres, lamps, separate; default: all

Makes the stages in a temporary folder: a point instancer of 100,000 sphere lights, one of 100,000
lamps of two triangles, and 10,000 separate lights, all above a floor. Each is loaded in a process
of its own, which tells its peak memory, Python and Mitsuba included. Renders are 256 x 144 pixels
of 16 samples, the second one of two. For scale the last column renders `manylights.scenes.city`
with as many emissive triangles, at most a million: one mesh, which no stage was read for.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SIZES = {"spheres": 100_000, "lamps": 100_000, "separate": 10_000}
VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
WIDTH, HEIGHT, SPP = 256, 144, 16

STAGE = """#usda 1.0
def Camera "camera" {
    double3 xformOp:translate = (0, 3, 60)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Mesh "floor" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-99, -1, 99), (99, -1, 99), (99, -1, -99), (-99, -1, -99)]
}
"""

LIGHT = 'def SphereLight "NAME" {\nfloat inputs:radius = 0.02\nfloat inputs:intensity = 5\nPLACE}\n'

LAMP = """def Mesh "lamp" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-0.02, 0, -0.02), (0.02, 0, -0.02), (0.02, 0, 0.02), (-0.02, 0, 0.02)]
    uniform token orientation = "leftHanded"
    rel material:binding = </glow>
}
"""

GLOW = """def Material "glow" {
    token outputs:surface.connect = </glow/surface.outputs:surface>
    def Shader "surface" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:emissiveColor = (9, 7, 5)
        token outputs:surface
    }
}
"""


def stage_text(name: str) -> str:
    """Return a stage of one of `SIZES`."""
    places = np.random.default_rng(1).uniform([-40, 0, -40], [40, 5, 40], (SIZES[name], 3))
    texts = ["({:.4f}, {:.4f}, {:.4f})".format(*place) for place in places]
    if name == "separate":
        order = 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
        ops = [f"double3 xformOp:translate = {text}\n{order}" for text in texts]
        lights = (LIGHT.replace("NAME", f"l_{i}").replace("PLACE", op) for i, op in enumerate(ops))
        return STAGE + "".join(lights)
    inside = LAMP if name == "lamps" else LIGHT.replace("NAME", "lamp").replace("PLACE", "")
    arrays = f"point3f[] positions = [{', '.join(texts)}]\nint[] protoIndices = {[0] * len(texts)}"
    header = 'def PointInstancer "many" {\nrel prototypes = </many/lamp>\n'
    return f"{STAGE}{GLOW}{header}{arrays}\n{inside}}}\n"


def measure(source: str, variant: str) -> dict:
    """Load a stage, or a city of so many triangles, and render it twice; in a new process."""
    import manylights
    import manylights.usd
    import mitsuba as mi

    mi.set_variant(variant)
    start = time.perf_counter()
    if source.isdigit():
        description = manylights.scenes.city(int(source), width=WIDTH, height=HEIGHT)
    else:
        description = manylights.usd.load(source)
        film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}
        description["sensor"]["film"] = film
    read = time.perf_counter()
    scene = mi.load_dict(description)
    made = time.perf_counter()
    loaded_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for seed in range(2):
        start_render = time.perf_counter()
        np.array(mi.render(scene, spp=SPP, seed=seed))
    shapes = [emitter.get_shape() for emitter in scene.emitters()]
    return {
        "load": read - start,
        "load_dict": made - read,
        "triangles": sum(shape.primitive_count() for shape in shapes),
        "shapes": len(shapes),
        "render": time.perf_counter() - start_render,
        "loaded_peak": loaded_peak,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def in_child(source: str, variant: str) -> dict:
    """Return what `measure` finds in a process of its own."""
    command = [sys.executable, __file__, "--measure", source, variant]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    if sys.argv[1:2] == ["--measure"]:
        print(json.dumps(measure(*sys.argv[2:])))
        return
    head = ("stage", "variant", "s: `usd.load`", "`mi.load_dict`", "MB: loaded", "rendered",
            "triangles (meshes)", "s a render", "s of a city")  # fmt: skip
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:] or SIZES:
            path = Path(folder) / f"{name}.usda"
            path.write_text(stage_text(name))
            for variant in VARIANTS:
                found = in_child(str(path), variant)
                city = in_child(str(min(found["triangles"], 1_000_000)), variant)
                cells = [
                    *(f"{found[key]:.2g}" for key in ("load", "load_dict")),
                    *(f"{found[key]:,.0f}" for key in ("loaded_peak", "peak")),
                    f"{found['triangles']:,} ({found['shapes']})",
                    f"{found['render']:.2g}",
                    f"{city['render']:.2g}",
                ]
                print(f"| {name} | `{variant}` | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

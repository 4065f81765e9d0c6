"""Measure manylights against the light tree of Cycles, Blender's renderer.

    python -m venv blender && blender/bin/pip install bpy      # needs its own Python version
    python scenes/bench/against_cycles.py blender/bin/python [SCENE ...]

Both render the same triangles, points, fog and camera in turns, each in a process of its own:
direct light on surfaces and in fog, a box filter of one pixel, no clamping, threshold or
denoising, two threads. A scene is a generator of `manylights.scenes` with its arguments, such as
`city:1000,kind=points`.

Radiances of meshes are rounded to steps of a seventh, for both: there are few materials then, each
of constant radiance, which Cycles' tree can weigh. Diffuse surfaces and fog are the same in both;
rough plastic (in `city`) is as near as Blender's nodes come.

Error: variance of a render over the seeds, relative to the pixel's squared mean plus the square of
.05 of the image's mean, without the worst thousandth of the pixels. Time: ours of a whole render
after a first one; Cycles' of what its samples take, by the difference to a render of one sample.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

import drjit as dr
import mitsuba as mi
import numpy as np
from manylights.bench import metrics, scene_source

WIDTH, HEIGHT = 256, 144
THREADS, SEEDS, SAMPLES = 2, 8, 64
SCENES = (
    "open_plane:1000", "open_plane:10000", "city:1000,kind=points", "city:10000,kind=points",
    "city:1000", "city:10000", "city:100000", "rooms:1000", "rooms:10000",
    "house:1000", "house:10000", "fog_open:1000", "fog_street:1000", "fog_rooms:1000",
)  # fmt: skip


def load(text: str) -> mi.Scene:
    """Load a scene that is named as for `manylights bench`; radiances are attributes of faces."""
    texture = ",texture=false" if text.split(":")[0] in scene_source.TEXTURED else ""
    return scene_source.find(f"{text},width={WIDTH},height={HEIGHT}{texture}").load().scene


def rounded(radiance: np.ndarray) -> np.ndarray:
    """Round colours (n, 3) to steps of their largest channel, of which an octave has five."""
    largest = radiance.max(axis=1, keepdims=True)
    step = np.round(5.0 * np.log2(largest)) / 5.0
    return np.round(radiance / largest, 3) * 2.0**step


def vertices_and_faces(parameters) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (v, 3) and the faces (f, 3) of a mesh or a rectangle."""
    if "faces" in parameters:
        names = ("vertex_positions", "faces")
        return tuple(np.array(parameters[name]).reshape(-1, 3) for name in names)
    corners = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]], dtype=float)
    matrix = np.array(parameters["to_world"].matrix).reshape(4, 4)
    return (corners @ matrix.T)[:, :3], np.array([[0, 1, 2], [0, 2, 3]])


def export_shape(shape: mi.Shape, index: int, data: dict) -> None:
    """Add a shape to what Blender reads; the radiance of a mesh is rounded in place, too."""
    parameters, bsdf = mi.traverse(shape), mi.traverse(shape.bsdf())
    medium = shape.interior_medium()
    data[f"vertices_{index}"], data[f"faces_{index}"] = vertices_and_faces(parameters)
    if medium is not None:
        fog = mi.traverse(medium)
        names = ("sigma_t.value.value", "albedo.value.value")
        data[f"fog_{index}"] = [float(np.ravel(fog[name])[0]) for name in names]
        return
    color = parameters.get("face_color")
    if shape.is_emitter():
        color = rounded(np.array(color).reshape(-1, 3))
        parameters["face_color"] = np.ravel(color)
        parameters.update()
        data[f"radiance_{index}"] = color * parameters["emitter.radiance.scale"]
        return
    if color is None:
        color = next(value for name, value in bsdf if name.endswith("reflectance.value"))
    data[f"color_{index}"] = np.array(color).reshape(-1, 3)
    if "alpha" in bsdf:
        data[f"lobe_{index}"] = [float(np.ravel(bsdf[name])[0]) for name in ("alpha", "eta")]


def export(scene: mi.Scene, path: Path) -> None:
    """Write what the worker needs to build the scene in Blender."""
    data: dict = {"shapes": len(scene.shapes())}
    for index, shape in enumerate(scene.shapes()):
        export_shape(shape, index, data)
    emitters = [mi.traverse(emitter) for emitter in scene.emitters()]
    points = [emitter for emitter in emitters if "position" in emitter]
    data["positions"] = np.array([np.ravel(p["position"]) for p in points])
    data["intensities"] = np.array([np.ravel(p["intensity.value"]) for p in points])
    camera = mi.traverse(scene.sensors()[0])
    # Mitsuba's cameras look along z with x to the left, Blender's along -z with x to the right
    matrix = np.array(camera["to_world"].matrix).reshape(4, 4) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    data["camera"], data["fov"] = matrix, np.radians(float(np.ravel(camera["x_fov"])[0]))
    data["size"] = (WIDTH, HEIGHT)
    np.savez(path, **data)


class Blender:
    """A process that renders with Cycles."""

    def __init__(self, python: str, folder: Path, log: IO) -> None:
        worker = Path(__file__).with_name("against_cycles_worker.py")
        self.folder = folder
        self.log = log
        self.process = subprocess.Popen(
            [python, str(worker), str(THREADS)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )

    def ask(self, **request) -> dict:
        try:
            print(json.dumps(request), file=self.process.stdin, flush=True)
            answer = self.process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self.log.seek(0)
            sys.exit(f"Blender's process has ended: {self.log.read()}")
        return json.loads(answer)

    def load(self, path: Path) -> None:
        self.ask(load=str(path))

    def render(self, spp: int, seed: int, light_tree: bool) -> tuple[np.ndarray, float]:
        """Return the picture (height, width, 3) and the seconds it took."""
        path = str(self.folder / "image.exr")
        answer = self.ask(light_tree=light_tree, spp=spp, seed=seed, image=path)
        return np.array(mi.Bitmap(path), dtype=float)[..., :3], answer["seconds"]


def render(scene: mi.Scene, integrator, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Return our picture and the seconds it took."""
    start = time.perf_counter()
    image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), dtype=float)
    return image[..., :3], time.perf_counter() - start


def relative_variance(images: list[np.ndarray]) -> float:
    """Return the trimmed mean of the relative variance of one image."""
    mean, variance = np.mean(images, axis=0), np.var(images, axis=0, ddof=1)
    errors = variance.mean(axis=2) / metrics.squared_scale(mean)
    return metrics.trimmed_mean(errors)


def measure(blender: Blender, scene: mi.Scene) -> dict:
    """Return error, seconds and mean of ours and of Cycles without and with its light tree."""
    fog = any(shape.interior_medium() is not None for shape in scene.shapes())
    direct, volpath = {"type": "manylights_direct"}, {"type": "manylights_volpath", "max_depth": 2}
    integrator = mi.load_dict(volpath if fog else direct)
    render(scene, integrator, SAMPLES, 0)
    ours = np.median([render(scene, integrator, SAMPLES, seed)[1] for seed in range(3)])
    methods = {"manylights": lambda seed: render(scene, integrator, SAMPLES, seed)}
    samples, fixed = {"manylights": SAMPLES}, {"manylights": 0.0}
    for name, tree in (("cycles", True), ("cycles_without_tree", False)):
        blender.render(1, 0, tree)
        fixed[name] = min(blender.render(1, seed, tree)[1] for seed in range(3))
        # As many samples as take about as long as ours
        probe = max(1e-3, blender.render(1 + SAMPLES, 0, tree)[1] - fixed[name]) / SAMPLES
        samples[name] = max(2, 1 + round(ours / probe))
        methods[name] = lambda seed, name=name, tree=tree: blender.render(samples[name], seed, tree)
    images, seconds = {name: [] for name in methods}, {name: [] for name in methods}
    for seed in range(1, SEEDS + 1):
        for name, method in methods.items():
            image, duration = method(seed)
            images[name].append(image)
            seconds[name].append(duration - fixed[name])
    return {
        name: {
            "samples": samples[name],
            "seconds": float(np.median(seconds[name])),
            "error": relative_variance(images[name]),
        }
        for name in methods
    }


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    python, *scenes = sys.argv[1:]
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(THREADS)
    print("| scene | samples | seconds | error | error times time over ours |")
    print("|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryFile("w+") as log:
        folder = Path(name)
        blender = Blender(python, folder, log)
        for text in scenes or SCENES:
            scene = load(text)
            export(scene, folder / "scene.npz")
            blender.load(folder / "scene.npz")
            print(table_row(text, measure(blender, scene)), flush=True)


def table_row(text: str, result: dict) -> str:
    """Return a line of Markdown: manylights / Cycles with its light tree / without."""
    columns = [[one[key] for one in result.values()] for key in ("samples", "seconds", "error")]
    cost = [one["error"] * one["seconds"] for one in result.values()]
    columns.append([value / cost[0] for value in cost[1:]])
    cells = [" / ".join(f"{value:.3g}" for value in column) for column in columns]
    return f"| `{text}` | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()

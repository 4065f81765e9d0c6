"""Render the README's picture pairs: Mitsuba's integrators and ours at equal time.

    python scenes/pictures/equal_time.py [city] [fog]

The city's windows are one textured mesh, so that Mitsuba chooses points on it in proportion to
their radiance, which is the best of its own ways to sample this scene. Times are medians of
three renders after a first one; both pictures come from the same process.
"""

import sys
import time
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
from manylights.bench import metrics

mi.set_variant("llvm_ad_rgb")
FOLDER = Path(__file__).parent
SIZE = {"width": 480, "height": 270}
LIGHTS = 20_000
REFERENCE_SAMPLES = 256


def render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
    """Render to an array (height, width, 3)."""
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3]


def render_time(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> float:
    """Median seconds of three renders, compilation excluded."""
    render(scene, integrator, spp, 0)
    seconds = []
    for seed in range(1, 4):
        start = time.perf_counter()
        render(scene, integrator, spp, seed)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def write(image: np.ndarray, name: str) -> None:
    """Write an 8-bit sRGB picture."""
    bitmap = mi.Bitmap(image.astype(np.float32))
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    bitmap.write(str(FOLDER / name), quality=90)


def city() -> tuple:
    """The scene, both integrators, the names of the pictures, and our samples per pixel."""
    scene = manylights.scenes.city(LIGHTS, kind="mesh", texture=True, **SIZE)
    return scene, {"type": "direct"}, {"type": "manylights_direct"}, ("direct", "manylights"), 16


def fog() -> tuple:
    """The same for the street in fog, with up to three scatterings."""
    scene = manylights.scenes.fog_street(LIGHTS, kind="mesh", texture=True, **SIZE)
    theirs, ours = ({"type": name, "max_depth": 4} for name in ("volpath", "manylights_volpath"))
    return scene, theirs, ours, ("volpath", "manylights_fog"), 8


def render_pair(description: dict, theirs: dict, ours: dict, names: tuple, samples: int) -> None:
    """Render with ours, then with as many samples of theirs as take the same time."""
    scene = mi.load_dict(description)
    ours, theirs = mi.load_dict(ours), mi.load_dict(theirs)
    parts = range(REFERENCE_SAMPLES // 64)
    reference = np.mean([render(scene, ours, 64, 100 + part) for part in parts], axis=0)

    seconds = render_time(scene, ours, samples)
    # Mitsuba's time is proportional to the samples: find the number that takes as long
    spp = max(1, round(samples * seconds / render_time(scene, theirs, samples)))
    for name, integrator, count in zip(names, (theirs, ours), (spp, samples)):
        taken = render_time(scene, integrator, count)
        image = render(scene, integrator, count, 7)
        write(image, f"{name}.jpg")
        print(
            f"{name}: {count} spp, {taken:.2f} s, "
            f"relative mean squared error {metrics.relative_mse(image, reference, metrics.TRIM):.4f}"
        )


def main() -> None:
    for name in sys.argv[1:] or ("city", "fog"):
        render_pair(*{"city": city, "fog": fog}[name]())


if __name__ == "__main__":
    main()

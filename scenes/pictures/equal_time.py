"""Render the README's picture pair: Mitsuba's `direct` and `manylights_direct` at equal time.

    python scenes/pictures/equal_time.py

The city's windows are one textured mesh, so that Mitsuba chooses points on it in proportion to
their radiance, which is the best of its own ways to sample this scene. Times are medians of
three renders after a first one; both pictures come from the same process.
"""

import time
from pathlib import Path

import mitsuba as mi
import numpy as np

import manylights

mi.set_variant("llvm_ad_rgb")
FOLDER = Path(__file__).parent
SIZE = {"width": 480, "height": 270}
LIGHTS = 20_000
SAMPLES = 16


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


def relative_error(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean of (x - r)^2 / (r^2 + (0.05 mean r)^2) over pixels, without the worst 0.1 %."""
    error = np.mean((image - reference) ** 2, axis=2)
    error /= np.mean(reference, axis=2) ** 2 + (0.05 * reference.mean()) ** 2
    error = np.sort(error.ravel())
    return float(error[: int(0.999 * error.size)].mean())


def write(image: np.ndarray, name: str) -> None:
    """Write an 8-bit sRGB picture."""
    bitmap = mi.Bitmap(image.astype(np.float32))
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    bitmap.write(str(FOLDER / name), quality=90)


def main() -> None:
    scene = mi.load_dict(manylights.scenes.city(LIGHTS, kind="mesh", texture=True, **SIZE))
    ours = mi.load_dict({"type": "manylights_direct"})
    theirs = mi.load_dict({"type": "direct"})
    reference = np.mean([render(scene, ours, 128, 100 + i) for i in range(4)], axis=0)

    seconds = render_time(scene, ours, SAMPLES)
    # Mitsuba's time is proportional to the samples: find the number that takes as long
    spp = max(1, round(SAMPLES * seconds / render_time(scene, theirs, SAMPLES)))
    for name, integrator, samples in (("direct", theirs, spp), ("manylights", ours, SAMPLES)):
        taken = render_time(scene, integrator, samples)
        image = render(scene, integrator, samples, 7)
        write(image, f"{name}.jpg")
        print(
            f"{name}: {samples} spp, {taken:.2f} s, "
            f"relative mean squared error {relative_error(image, reference):.4f}"
        )


if __name__ == "__main__":
    main()

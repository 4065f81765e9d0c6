"""Made-up measurements in the form that `manylights bench` writes, for tests of the report.

Errors fall as 1 / samples with a spread between seeds, and images are a pattern plus noise.
"""

from __future__ import annotations

import json
import re

import mitsuba as mi
import numpy as np

WIDTH, HEIGHT = 80, 45
SEEDS = 5
REFERENCE_MEAN = 0.25

#: Error of one sample a pixel and nanoseconds of a sample: what a method is, for a chart.
METHODS = {
    "uniform": (300.0, 120.0),
    "power": (40.0, 130.0),
    "talk": (3.0, 900.0),
    "talk:splitting_rate=2": (2.2, 1300.0),
    "talk:splitting_rate=4": (1.5, 2000.0),
    "talk:splitting_rate=8": (1.2, 3600.0),
    "adaptive_splitting": (2.5, 700.0),
    "tree": (12.0, 250.0),
    "resampled_tree": (1.0, 400.0),
    "resampled_tree:splitting_rate=0": (9.0, 220.0),
    "resampled_tree:splitting_rate=2": (0.8, 600.0),
    "resampled_tree:splitting_rate=4": (0.7, 1100.0),
    "resampled_tree:reservoirs=2": (2.0, 330.0),
    "resampled_tree:reservoirs=32": (0.9, 520.0),
    "resampled_tree:shadow_rays=1": (2.6, 260.0),
    "resampled_tree:shadow_rays=8": (0.8, 640.0),
}
PLAIN = tuple(spec for spec in METHODS if ":" not in spec)


def write_results(folder, scenes=None):
    """Write a folder of results and return what is in its results.json."""
    mi.set_variant("scalar_rgb")
    data = {
        "format": 1,
        "created": "2026-11-22T09:00:00+00:00",
        "versions": {"manylights": "0.1.0", "mitsuba": "3.9.1", "drjit": "1.5.0"},
        "machine": {
            "processor": "Processor of the tests",
            "cores": 2,
            "threads": 2,
            "memory_gib": 7.7,
            "system": "Linux",
        },
        "variant": "llvm_ad_rgb",
        "metric": {"epsilon": 0.05, "trim": 0.001},
        "scenes": scenes or all_scenes(),
    }
    for scene in data["scenes"]:
        write_images(folder / scene["name"], scene)
    (folder / "results.json").write_text(json.dumps(data))
    return data


def all_scenes():
    """A family, a private scene, one across a boundary, and one where a peer is better."""
    city = [
        make_scene(f"city_{count}", "City", family="city", lights=count, specs=specs)
        for count, specs in ((100, PLAIN), (10_000, METHODS))
    ]
    hidden = make_scene("works", "Works", private=True, lights=5000, source="private/works.xml")
    boundary = make_scene("step", "Two groups of lights", boundary=True, lights=64)
    # Far more time than others: here the peers win.
    glossy = make_scene("glossy", "Glossy metal", lights=1000, slower=30.0)
    return [*city, hidden, boundary, glossy]


def make_scene(name, title, specs=PLAIN, lights=1000, slower=1.0, **changes):
    """One entry of `scenes`; `slower` multiplies the time of our method."""
    random = np.random.default_rng(lights)
    if changes.get("family"):
        title = f"{title}, {lights:,} lights"
    scene = {
        "name": name,
        "title": title,
        "family": name,
        "lights": lights,
        "source": f"{name}:{lights}",
        "hash": "0" * 64,
        "width": WIDTH,
        "height": HEIGHT,
        "max_depth": 2,
        "media": False,
        "private": False,
        "boundary": False,
        "equal_time": 0.05,
        "reference": {
            "integrator": "manylights_direct",
            "spp": 4096,
            "seconds": 31.2,
            "error": 4e-4,
            "mean": REFERENCE_MEAN,
            "mean_error": 2e-5,
        },
        "series": [make_series(spec, lights, slower, random) for spec in specs],
        "skipped": [{"spec": "exhaustive", "why": "more than 10,000 lights"}],
    }
    return {**scene, **changes}


def make_series(spec, lights, slower, random):
    """Points of one method: Mitsuba's own get worse with the number of lights."""
    error, nanoseconds = METHODS[spec]
    method, *settings = spec.split(":")
    parameters = {key: float(value) for key, value in (text.split("=") for text in settings)}
    mitsubas = method in ("uniform", "power")
    error *= (lights / 1000) ** (0.5 if mitsubas else 0.05)
    nanoseconds *= slower if method == "resampled_tree" else 1.0
    points = [make_point(spp, error, nanoseconds, random) for spp in (1, 4, 16, 64, 256)]
    return {
        "spec": spec,
        "method": method,
        "parameters": parameters,
        "integrator": {"type": "direct" if mitsubas else "manylights_direct"},
        "build_seconds": 0 if mitsubas else 2e-6 * lights,
        "first_seconds": 1.5 + 2e-6 * lights,
        "equal_time": {
            "spp": 16,
            "seconds": 0.05,
            "error": error / 14,
            "error_trimmed": error / 16,
            "flip": min(1.0, error / 50),
        },
        "points": points,
    }


def make_point(spp, error, nanoseconds, random):
    """Renders with several seeds."""
    spread = random.normal(0, 1, (4, SEEDS))
    trimmed = (error / spp + 4e-4) * np.exp(0.08 * spread[0])
    seconds = 0.002 + 1e-9 * nanoseconds * spp * WIDTH * HEIGHT * np.exp(0.03 * spread[1])
    return {
        "spp": spp,
        "seed": list(range(1, SEEDS + 1)),
        "seconds": seconds.tolist(),
        "cpu_seconds": (1.9 * seconds).tolist(),
        "error": (trimmed * (1.3 + 0.1 * np.abs(spread[2]))).tolist(),
        "error_trimmed": trimmed.tolist(),
        "flip": np.clip(trimmed, 0, 1).tolist(),
        "mean": (REFERENCE_MEAN * (1 + 0.002 * np.sqrt(error / spp) * spread[3])).tolist(),
    }


def write_images(folder, scene):
    """Write the reference and the images of each series of a scene."""
    folder.mkdir()
    random = np.random.default_rng(1)
    columns, rows = np.meshgrid(np.arange(WIDTH) / WIDTH, np.arange(HEIGHT) / HEIGHT)
    pattern = 0.05 + np.exp(-30 * ((columns - 0.6) ** 2 + (rows - 0.4) ** 2))
    reference = pattern[..., None] * np.array([1.0, 0.8, 0.5])
    write_exr(folder / "reference.exr", reference)
    for series in scene["series"]:
        key = re.sub("[:=]", "-", series["spec"])
        deviation = np.sqrt(series["equal_time"]["error_trimmed"]) * reference
        noisy = reference + deviation * random.normal(size=reference.shape)
        write_exr(folder / f"{key}.exr", np.maximum(noisy, 0))
        # Deterministic splitting has a step in the middle.
        step = 1 + 2 * (columns > 0.5) if series["method"] == "adaptive_splitting" else 1 + columns
        variance = 16 * deviation**2 * np.square(step)[..., None] / reference**2
        write_exr(folder / f"{key}.variance.exr", variance)
        if series["method"] not in ("uniform", "power"):
            counts = np.stack([8 * pattern + 2, 40 * pattern + 10], axis=-1)
            write_exr(folder / f"{key}.maps.exr", counts, ["candidates", "node_visits"])


def write_exr(path, image, channels=None):
    """Write an image; channels other than R, G and B have names."""
    image = np.ascontiguousarray(image, np.float32)
    if channels is None:
        mi.Bitmap(image).write(str(path))
    else:
        kind = mi.Bitmap.PixelFormat.MultiChannel
        mi.Bitmap(image, kind, channels).write(str(path))

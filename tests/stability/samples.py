"""Renders the cases: single samples for their distribution, and means with their references."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from tests import closed_form
from tests import statistics_tools as tools
from tests.references import ERROR, make_reference, planned_images, set_power_weights
from tests.shared_results import shared
from tests.stability.cases import CASES

TAIL_SIZE, TAIL_SEEDS, REFERENCE_SEEDS = 256, 4, 2
"""Single samples: pixels of images with one sample per pixel, which are enough for learning."""
MILLION_SEEDS = 16
"""Images that have a million of them together."""
RARE = 1e-4
"""Share of the samples in a tail."""
PERCENTILES = Path(__file__).with_name("percentiles.json")
MEAN_SIZE = 16
BLOCK = 4
"""Means are compared over squares of that many pixels."""


def load(description, size):
    """The scene of a dictionary, with a film of size x size pixels."""
    description["sensor"]["film"] |= {"width": size, "height": size}
    return mi.load_dict(description)


def integrator(name, **parameters):
    """The integrator under test for a case."""
    parameters = {**CASES[name].parameters, **parameters}
    kind = "manylights_volpath" if "max_depth" in parameters else "manylights_direct"
    return mi.load_dict({"type": kind, **parameters})


def single_samples(name, seeds=TAIL_SEEDS, **parameters):
    """Brightness of single samples of a case, (seeds, pixels)."""
    return brightness(CASES[name].scene(), integrator(name, **parameters), seeds)


def reference_samples(name):
    """The same with all lights as candidates, resampled like the default's."""
    return single_samples(name, REFERENCE_SEEDS, method="exhaustive")


@dataclass(frozen=True)
class Tail:
    """The 99.99th percentile of samples, and how many of them are above it."""

    percentile: float
    above: int
    of: int


def tail_of(values):
    """The tail of samples."""
    percentile = float(np.quantile(values, 1 - RARE))
    return Tail(percentile, int((values > percentile).sum()), values.size)


def reference_tail(name):
    """That of `reference_samples`, from percentiles.json."""
    return Tail(**json.loads(PERCENTILES.read_text())[name])


def brightness(description, integrator, seeds=TAIL_SEEDS):
    """The same for any scene's dictionary."""
    scene = load(description, TAIL_SIZE)
    images = tools.render_seeds(scene, integrator, spp=1, seeds=range(seeds))
    return images.mean(axis=-1).reshape(seeds, -1)


def images(name, **parameters):
    """Images of the integrator under test, as many as its mean needs."""
    scene = load(CASES[name].scene(), MEAN_SIZE)
    error = ERROR["tested alone" if CASES[name].plain else "tested"]
    return planned_images(scene, integrator(name, **parameters), error, first_seed=0)


def has_box_filter(name):
    """True if the pixels of a case are independent."""
    return CASES[name].scene()["sensor"]["film"]["rfilter"]["type"] == "box"


def plain_image(description, order=4):
    """Expected image of a diffuse floor under points and spots, without Mitsuba."""
    size = description["sensor"]["to_world"].matrix
    centre = np.array(description["floor"]["to_world"].matrix)[:3, 3]
    nodes = (np.arange(MEAN_SIZE * order) + 0.5) / (MEAN_SIZE * order)
    x, y = np.meshgrid(2 * nodes - 1, 1 - 2 * nodes)
    half = np.linalg.norm(np.array(size)[:3, 0])
    points = np.stack([half * x, half * y, 0 * x], axis=-1)
    lights = [
        closed_form_light(light, centre) for key, light in description.items() if "light" in key
    ]
    albedo = description["floor"]["bsdf"]["reflectance"]["value"]
    radiance = closed_form.reflected_radiance(points, lights, albedo)
    return radiance.reshape(MEAN_SIZE, order, MEAN_SIZE, order, 3).mean(axis=(1, 3))


def closed_form_light(light, centre):
    """A point or spot of a scene's dictionary, its position relative to the centre."""
    if light["type"] == "point":
        place = np.subtract(light["position"], centre)
        return closed_form.Light(tuple(place), tuple(light["intensity"]["value"]))
    frame = np.array(light["to_world"].matrix)
    return closed_form.Light(
        tuple(frame[:3, 3] - centre),
        tuple(light["intensity"]["value"]),
        tuple(frame[:3, 2]),
        light["cutoff_angle"],
        light["beam_width"],
    )


@shared
def reference_images(name, variant):
    """Images of the same mean: a closed form, or Mitsuba's emitters one by one, or `volpath`."""
    if CASES[name].plain:
        return plain_image((CASES[name].same_as or CASES[name].scene)())[np.newaxis]
    before = mi.variant()
    mi.set_variant(variant)
    try:
        case = CASES[name]
        scene = load((case.same_as or case.scene)(), MEAN_SIZE)
        if "max_depth" in case.parameters:
            set_power_weights(scene)
            known, error = mi.load_dict({"type": "volpath", **case.parameters}), ERROR["uniform"]
        else:
            known, error = make_reference("exhaustive"), ERROR["exhaustive"]
        return planned_images(scene, known, error, first_seed=100_000, known=True)
    finally:
        mi.set_variant(before)

"""Independent estimates of direct light that the plugin's images are compared with.

- `uniform`: Mitsuba's `direct`, which picks one emitter with equal probabilities.
- `power`: the same with probabilities from the emitters' power.
- `exhaustive`: every emitter at every shading point, see `exhaustive.py`.
- `bsdf`: BSDF sampling alone, for emitters that Mitsuba samples wrongly.

References are rendered in an LLVM variant where there is one, since it is much faster; the
expectation is that of the scalar variant. They are kept for the rest of the run.
"""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
from manylights.loading import has_backend

from tests import light_scenes
from tests import statistics_tools as tools

SEEDS = 32
"""Renderings per estimate: enough degrees of freedom for the t test's far tail to be short."""

ERROR = {"uniform": 1.4e-3, "power": 1.4e-3, "bsdf": 1.4e-3, "exhaustive": 1e-3, "tested": 1.5e-3}
"""Relative standard error of the image mean that the number of samples is chosen for.

To find a bias of 2 % with `tools.SIGNIFICANCE` and `tools.POWER` the difference may have one of
0.25 % (8 standard errors with 40 to 60 degrees of freedom); the noisiest pair here has 0.21 %, and
mostly less, since the pilot over-estimates the variance.
"""

LLVM_TWIN = {
    "scalar_rgb": "llvm_ad_rgb",
    "scalar_spectral": "llvm_ad_spectral",
}


def reference_variant(variant):
    """The variant that renders the references of `variant`."""
    twin = LLVM_TWIN.get(variant, variant)
    has_llvm = twin in mi.variants() and has_backend(dr.JitBackend.LLVM)
    return twin if has_llvm else variant


def planned_images(scene, integrator, error, first_seed, sensor=0):
    """Render `SEEDS` images with as many samples as the relative `error` of their mean needs.

    Numbers of samples are odd: LLVM variants compile one kernel for powers of two and another one
    for all other numbers.
    """
    pilot_spp = 5
    pilot_seeds = range(first_seed, first_seed + 16)
    pilot = tools.render_seeds(scene, integrator, pilot_spp, pilot_seeds, sensor)
    spp = tools.samples_for_precision(pilot, pilot_spp, SEEDS, error)
    seeds = range(first_seed + 1000, first_seed + 1000 + SEEDS)
    return tools.render_seeds(scene, integrator, max(pilot_spp, spp | 1), seeds, sensor)


def set_power_weights(scene, samples=64):
    """Give each emitter a sampling weight from its power, estimated with emitted rays.

    A tenth of the average is added, so that no emitter is starved.
    """
    powers = emitter_powers(scene, samples)
    weights = powers / (powers.mean() or 1) + 0.1  # black scenes have no power
    for emitter, weight in zip(scene.emitters(), weights):
        parameters = mi.traverse(emitter)
        parameters["sampling_weight"] = float(weight)
        parameters.update()
    scene.parameters_changed()


def emitter_powers(scene, samples):
    """Rough power of each emitter of the scene."""
    count = len(scene.emitters())
    numbers = np.random.default_rng(0).random((5, count * samples))
    if mi.variant().startswith("scalar"):
        powers = [
            ray_weight(emitter, numbers[:, index])
            for index, emitter in enumerate(np.repeat(scene.emitters(), samples))
        ]
    else:
        which = dr.arange(mi.UInt32, count * samples) // samples
        emitters = dr.gather(mi.EmitterPtr, scene.emitters_dr(), which)
        powers = ray_weight(emitters, [mi.Float(row) for row in numbers])
    return np.array(powers, dtype=float).reshape(count, samples).mean(axis=1)


def ray_weight(emitter, numbers):
    """Power carried by one random emitted ray."""
    position, direction = mi.Point2f(numbers[1:3]), mi.Point2f(numbers[3:5])
    weight = emitter.sample_ray(0, numbers[0], position, direction)[1]
    return dr.mean(mi.unpolarized_spectrum(weight))


def make_reference(kind, bsdf_samples=1, hide_emitters=False):
    """The integrator of a kind of reference in the current variant."""
    if kind == "exhaustive" and "scalar" not in mi.variant():
        if hide_emitters:
            raise ValueError("the exhaustive integrator always shows emitters")
        from tests.exhaustive import make_exhaustive

        return make_exhaustive(bsdf_samples=bsdf_samples > 0)
    return mi.load_dict(
        {
            "type": "direct",
            # More than one sample of delta lights is too bright in Mitsuba 3.9.1.
            "emitter_samples": 0 if kind == "bsdf" else 1,
            "bsdf_samples": bsdf_samples,
            "hide_emitters": hide_emitters,
        }
    )


@functools.cache
def reference_images(name, kind, variant, bsdf_samples=1, hide_emitters=False):
    """Images (seeds, height, width, channels) of the scene `name`; restores the variant."""
    before = mi.variant()
    mi.set_variant(variant)
    try:
        scene = light_scenes.load_reference(name)
        if kind == "power":
            set_power_weights(scene)
        integrator = make_reference(kind, bsdf_samples, hide_emitters)
        return planned_images(scene, integrator, ERROR[kind], first_seed=100_000)
    finally:
        mi.set_variant(before)

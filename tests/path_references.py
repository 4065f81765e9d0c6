"""The path tracer under test, and the integrators of Mitsuba that it is compared with.

Scenes without media are compared with `path`, those with media, or with surfaces that let light
pass straight on, with `volpath`. Emitters are chosen by power for the references, which leaves
their mean alone and saves most of the samples. As for direct light the references of scalar
variants are rendered in the LLVM variant with the same spectra, and kept for the rest of the run.
"""

from __future__ import annotations

from functools import cache

import mitsuba as mi
import pytest

from tests import path_scenes
from tests.references import ERROR, planned_images, set_power_weights
from tests.shared_results import shared

INTEGRATOR = "manylights_volpath"
"""The plugin that all tests of path tracing are about."""

INFINITY = float("inf")

# One-factor variations of the parameters, then combinations of extremes. Later parameters of the
# plugin belong here.
PARAMETERS = (
    {"splitting_rate": 0},
    {"splitting_rate": 4},
    {"splitting_rate": INFINITY},
    {"reservoirs": 1, "shadow_rays": 1},
    {"reservoirs": 8, "shadow_rays": 2},
    {"reservoirs": 16, "shadow_rays": 1},
    {"reservoirs": 16, "shadow_rays": 4},
    {"splitting_rate": 0, "reservoirs": 1, "shadow_rays": 1},
    {"splitting_rate": INFINITY, "reservoirs": 4, "shadow_rays": 4},
)
METHODS = (
    {"method": "resampled_tree"},
    {"method": "talk"},
    {"method": "talk", "split_function": "far"},
    {"method": "adaptive_splitting"},
    {"method": "tree"},
    {"method": "exhaustive"},
)

MAX_DEPTH = 4
"""Default path depth of the tests: three bounces."""


def parameter_id(parameters):
    """A readable test id: `reservoirs=4,shadow_rays=1`."""
    return ",".join(f"{name}={value}" for name, value in parameters.items())


def quick_and_slow(values, quick):
    """Values as parameters of a test; those that are not in `quick` are marked as slow."""
    return [
        pytest.param(value, marks=[] if value in quick else [pytest.mark.slow]) for value in values
    ]


def light_tree(**parameters):
    """The integrator under test."""
    return mi.load_dict({"type": INTEGRATOR, **parameters})


def known(name, **parameters):
    """Mitsuba's integrator for the scene `name`."""
    kind = "path" if name in path_scenes.SURFACES and not lets_light_through(name) else "volpath"
    return mi.load_dict({"type": kind, **parameters})


@cache
def lets_light_through(name):
    """Has the scene `name` surfaces that light passes straight on?"""
    shapes = path_scenes.load(name).shapes()
    return any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null) for shape in shapes)


def depth_of(name):
    """The default path depth for the scene `name`."""
    return 2 if name in path_scenes.SINGLE_SCATTERING else MAX_DEPTH


def plugin_images(name, sensor=0, **parameters):
    """Images (seeds, height, width, channels) of the integrator under test."""
    scene = path_scenes.load(name)
    integrator = light_tree(**{"max_depth": depth_of(name), **parameters})
    error = error_of(name, "tested")
    return planned_images(scene, integrator, error, first_seed=0, sensor=sensor)


def error_of(name, side):
    """The error that images of the scene `name` are planned for.

    Of lamps that fog touches a few samples have much of the light, of which pilots tell too little.
    """
    return ERROR[side] * (0.8 if name in path_scenes.CUT_LAMPS else 1)


def weigh_emitters(name, scene):
    """Set the weights with which Mitsuba's integrators choose emitters of the scene `name`.

    Lamps that it must not choose are found by chance.
    """
    set_power_weights(scene)
    for shape in scene.shapes() if name in path_scenes.CUT_LAMPS else ():
        if shape.is_emitter():
            parameters = mi.traverse(shape.emitter())
            parameters["sampling_weight"] = 0.0
            parameters.update()
    scene.parameters_changed()


@shared
def known_images(name, variant, sensor=0, **parameters):
    """Images of Mitsuba's integrator, rendered in `variant`; restores the current one."""
    before = mi.variant()
    mi.set_variant(variant)
    try:
        scene = path_scenes.load(name)
        weigh_emitters(name, scene)
        integrator = known(name, **{"max_depth": depth_of(name), **parameters})
        return planned_images(
            scene, integrator, error_of(name, "uniform"), 100_000, sensor, known=True
        )
    finally:
        mi.set_variant(before)

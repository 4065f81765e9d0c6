"""Single scattering along a view that meets the light of a lamp on a part of its way only.

Spots light the fog in their cone, flat lamps on one side: what lies before and behind is dark, and
so may be the point that is nearest to the lamp.
"""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest

from tests.path_references import light_tree
from tests.test_media_closed_forms import camera
from tests.test_path_closed_forms import assert_exact, both_variants, images_of

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

SIGMA, ALBEDO = 0.1, 0.8


def distances_along(z):
    """Distances along the view, which is the z axis: closer together near one of them."""
    near = np.geomspace(1e-7, 150, 100_001)
    nodes = np.concatenate([np.linspace(0, 150, 300_001), z + near, z - near])
    return np.unique(nodes[(nodes >= 0) & (nodes <= 150)])


def scene(lamps, x=0, fov=0.0001):
    """Lamps in fog without borders, seen along the z axis or a line beside it."""
    medium = {"type": "homogeneous", "sigma_t": SIGMA, "albedo": ALBEDO}
    view = camera((x, 0, 0), (x, 0, 1), fov=fov, up=(0, 1, 0), medium=medium)
    return {"type": "scene", "sensor": view, **lamps}


def spot(place, target, cutoff, beam=None, intensity=1.0):
    """A spot that shines at a target; angles in degrees."""
    frame = mi.ScalarTransform4f().look_at(list(place), list(target), [0, 1, 0.1])
    angles = {"cutoff_angle": cutoff, "beam_width": 0.75 * cutoff if beam is None else beam}
    return {"type": "spot", "to_world": frame, "intensity": intensity, **angles}


def small_disk(place, target, radius=1e-3):
    """A lamp that faces a target, of intensity 1 along its axis."""
    frame = mi.ScalarTransform4f().look_at(list(place), list(target), [0, 1, 0.1]).scale(radius)
    emitter = {"type": "area", "radiance": 1 / (np.pi * radius**2)}
    return {"type": "disk", "to_world": frame, "emitter": emitter}


def along_the_view(place, target, shape):
    """Light that a lamp sends along the view, whose intensity is ``shape`` of the cosine."""
    t = distances_along(place[2])
    w = np.stack(np.broadcast_arrays(-place[0], -place[1], t - place[2]), axis=-1)
    axis = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    r = np.linalg.norm(w, axis=-1)
    arrives = shape(w @ axis / r) / r**2 * np.exp(-SIGMA * (t + r))
    return np.trapezoid(ALBEDO * SIGMA / (4 * np.pi) * arrives, t)


def of_spot(place, target, cutoff, beam=None, intensity=1.0):
    """The same for a spot: falls from 1 at the beam's width to 0 at the cutoff, by the angle."""
    beam = 0.75 * cutoff if beam is None else beam
    angle = lambda cosine: np.degrees(np.arccos(np.clip(cosine, -1, 1)))  # noqa: E731
    fall = lambda cosine: np.clip((cutoff - angle(cosine)) / (cutoff - beam), 0, 1)  # noqa: E731
    return intensity * along_the_view(place, target, fall)


#: Lamp, target, angle of the cone. The nearest point of the view is dark but in the first two.
BEAMS = {
    "across": ((1, 0, 5), (0, 0, 5), 10),
    "wide": ((1, 0, 5), (0, 0, 6), 80),
    "ahead": ((1, 0.5, 5), (0, 0, 12), 3),
    "back": ((1, 0.5, 15), (0, 0, 6), 3),
    "along": ((0.5, 0, 5), (0.5, 0.1, 9), 12),
    "against": ((0.5, 0, 9), (0.5, 0.1, 3), 12),
    "behind the camera": ((1, 0, -5), (0, 0, 3), 5),
    "partly behind the camera": ((1, 0, 2), (0, 0, 0.1), 30),
    "half a sphere": ((1, 0, 5), (1, 0, 9), 90),
    "more than half": ((1, 0, 5), (1, 0, 9), 120),
    "close to the lamp": ((1e-3, 0, 5), (1e-3, 1e-3, 5.002), 60),
    "all but in it": ((1e-4, 0, 5), (0, 0, 5.0001), 60),
    "far away": ((1, 0, 50), (0, 0, 50.5), 1),
    "laser": ((1, 0, 5), (0, 0, 5.5), 0.3),
}


@both_variants
@pytest.mark.parametrize("name", BEAMS)
def test_beam_of_one_spot(variant, name):
    """By quadrature along the view."""
    exact = of_spot(*BEAMS[name])
    images = images_of(scene({"spot": spot(*BEAMS[name])}), max_depth=2)
    assert_exact(images, exact, label=f"{name}, {variant}")


@both_variants
def test_beam_that_does_not_meet_the_view(variant):
    """There is no light at all."""
    dark = spot((1, 0, 5), (2, 0, 5), 40)
    assert (images_of(scene({"spot": dark}), max_depth=2) == 0).all()


@both_variants
@pytest.mark.parametrize("target", [(1, 0, 4), (1, 0, 9), (0, 0, 5.5), (2, 0, 9), (2, 0.3, 4.5)])
def test_side_of_a_flat_lamp(variant, target):
    """By quadrature along the view: in front, behind, and before the lamp."""
    place = (1, 0, 5)
    exact = along_the_view(place, target, lambda cosine: np.maximum(cosine, 0))
    images = images_of(scene({"disk": small_disk(place, target)}), max_depth=2)
    assert_exact(images, exact, label=f"disk towards {target}, {variant}")


@cache
def far_beams():
    """A hundred spots, and their light along the view.

    Narrow ones, which have most of it, cross the view far ahead of them, where the nearest point is
    dark; the others turn away from it.
    """
    rng = np.random.default_rng(1)
    lamps, exact = {}, 0.0
    for i in range(100):
        x, y = rng.normal([2, 0])
        z, turn = rng.uniform(0, 30), rng.normal()
        if i % 25 == 0:
            lamp = ((x, y, z), (0, 0, z + 4), 2, None, 100.0)
        else:
            lamp = ((x, y, z), (2 * x, 2 * y, z + turn), 60)
        lamps[f"spot_{i}"] = spot(*lamp)
        exact += of_spot(*lamp)
    return scene(lamps), exact


@both_variants
def test_beams_among_other_lamps(variant):
    """Chosen by the light at the nearest point they would be found too seldom to tell 10 %."""
    lamps, exact = far_beams()
    assert_exact(images_of(lamps, max_depth=2), exact, label=variant)


@pytest.mark.parametrize("method", ["exhaustive", "talk"])
def test_beams_among_other_lamps_by_other_methods(llvm, method):
    """Where all lamps are seen, or each node is split or not."""
    lamps, exact = far_beams()
    assert_exact(images_of(lamps, max_depth=2, method=method), exact, label=method)


@both_variants
def test_guessed_targets_do_not_depend_on_the_origin(variant):
    """Spots with a picture, which their plugin samples: moving the scene changes no choice."""
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))}
    images = []
    for x in (0, 64):
        rng = np.random.default_rng(2)
        places = rng.uniform([x - 4, -4, 4], [x + 4, 4, 12], (40, 3))
        targets = places + rng.normal(size=(40, 3))
        lamps = {f"spot_{i}": spot(*ends, 40) for i, ends in enumerate(zip(places, targets))}
        for lamp in lamps.values():
            lamp["texture"] = texture
        moved = mi.load_dict(scene(lamps, x, fov=20))
        integrator = light_tree(max_depth=2, reservoirs=8, shadow_rays=1)
        images.append(np.array(mi.render(moved, integrator=integrator, spp=4)))
    same = np.isclose(images[0], images[1], rtol=1e-2)
    assert same.mean() > 0.9, f"{variant}: {1 - same.mean():.0%} of the pixels differ"

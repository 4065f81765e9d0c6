"""Emitters and textures that are written in Python: with or without a box, and changed later."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes
from tests import statistics_tools as tools
from tests.light_scenes import rgb, transform
from tests.test_path_gradients import full_text

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)

POSITION = [0.3, 0.2, 1.5]
INTENSITY = [3.0, 2.0, 1.0]

BIAS = 0.35
"""Relative bias that has to be found: the light alone is half of the image and more."""


def is_jit():
    """Is the current variant one that records kernels?"""
    return dr.is_jit_v(mi.Float)


def direction_sample(emitter, it, p, n):
    """From an interaction to a point on an emitter."""
    ds = dr.zeros(mi.DirectionSample3f) if is_jit() else mi.DirectionSample3f()
    ds.p, ds.n, ds.time = p, n, it.time
    ds.emitter = mi.EmitterPtr(emitter) if is_jit() else emitter
    ds.d = ds.p - it.p
    ds.dist = dr.norm(ds.d)
    ds.d /= ds.dist
    return ds


def register(name, box=False, flags=None, power=False):
    """Register a point light: with a box or without, and whatever flags it says that it has."""

    class Point(mi.Emitter):
        def __init__(self, props):
            super().__init__(props)
            self.position = mi.Point3f(*POSITION)
            self.intensity = mi.Color3f(*INTENSITY)
            self.m_flags = int(mi.EmitterFlags.DeltaPosition if flags is None else flags)

        def sample_direction(self, it, sample, active):
            ds = direction_sample(self, it, self.position, mi.Normal3f(0))
            ds.pdf, ds.delta = mi.Float(1), mi.Bool(True)
            return ds, dr.select(active, mi.Spectrum(self.intensity) / dr.square(ds.dist), 0)

        def pdf_direction(self, it, ds, active):
            return mi.Float(0)

        def traverse(self, callback):
            super().traverse(callback)
            callback.put("position", self.position, mi.ParamFlags.NonDifferentiable)
            callback.put("intensity", self.intensity, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys):
            pass

    if box:
        Point.bbox = lambda self: mi.ScalarBoundingBox3f(POSITION, POSITION)
    if power:
        Point.sample_ray = lambda self, time, s1, s2, s3, active: (
            mi.Ray3f(self.position, mi.warp.square_to_uniform_sphere(s3)),
            4 * np.pi * mi.Spectrum(self.intensity),
        )
    mi.register_emitter(name, Point)


KINDS = {
    "without_box": {},
    "with_box": {"box": True},
    "with_power": {"box": True, "power": True},
    "without_flags": {"flags": 0},
    "says_infinite": {"flags": mi.EmitterFlags.Infinite | mi.EmitterFlags.DeltaDirection},
}
INTEGRATORS = ("manylights_direct", "manylights_volpath")


def images(light, others, integrator, change=None):
    """Renderings with a light, after changes of its parameters if any are wanted."""
    limits = {} if integrator == "manylights_direct" else {"max_depth": 2}
    scene = light_scenes.stage(ball=None) | {"light": light}
    scene["sensor"]["film"] |= {"width": 12, "height": 8}
    scene = mi.load_dict(scene | light_scenes.points(others, total=1.0))
    integrator = mi.load_dict({"type": integrator, **limits})
    if change:
        mi.render(scene, integrator=integrator, spp=1)
        parameters = mi.traverse(scene)
        for key, value in change.items():
            parameters[f"light.{key}"] = value
        parameters.update()
    return tools.render_seeds(scene, integrator, 32, range(12))


@VARIANTS
@pytest.mark.parametrize("kind", KINDS)
def test_point_in_python(variant, kind):
    """The same light as from Mitsuba's own point, in both integrators."""
    register(f"python_{kind}", **KINDS[kind])
    own = {"type": "point", "position": POSITION, "intensity": rgb(INTENSITY)}
    for integrator in INTEGRATORS:
        found = images({"type": f"python_{kind}"}, 20, integrator)
        tools.assert_same_mean(found, images(own, 20, integrator), bias=BIAS, label=integrator)


@VARIANTS
@pytest.mark.parametrize("kind", ["without_box", "with_box"])
def test_changed_parameters_of_python(variant, kind):
    """Brighter, and elsewhere, after a first rendering."""
    register(f"python_{kind}", **KINDS[kind])
    moved = {"position": mi.Point3f(-0.5, 0.1, 1.0), "intensity": mi.Color3f(1.0, 5.0, 2.0)}
    own = {"type": "point", "position": [-0.5, 0.1, 1.0], "intensity": rgb([1.0, 5.0, 2.0])}
    found = images({"type": f"python_{kind}"}, 20, "manylights_direct", moved)
    tools.assert_same_mean(found, images(own, 20, "manylights_direct"), bias=BIAS)


def test_emitter_that_cannot_be_sampled(scalar):
    """Without `sample_direction` it is named, before anything is rendered.

    Not in a JIT variant: kernels call such an emitter as long as it is alive, in all scenes.
    """

    class Incomplete(mi.Emitter):
        pass

    mi.register_emitter("python_incomplete", Incomplete)
    with pytest.raises(RuntimeError) as raised:
        images({"type": "python_incomplete"}, 20, "manylights_direct")
    assert '"light" cannot be sampled' in full_text(raised.value)


def register_area():
    """An area light, without a function to send rays with."""

    class Area(mi.Emitter):
        def __init__(self, props):
            super().__init__(props)
            self.radiance = mi.Color3f(*INTENSITY)
            self.m_flags = int(mi.EmitterFlags.Surface)

        def eval(self, si, active):
            front = mi.Frame3f.cos_theta(si.wi) > 0
            return dr.select(active & front, mi.Spectrum(self.radiance), 0)

        def sample_direction(self, it, sample, active):
            ds = self.get_shape().sample_direction(it, sample, active)
            active &= (dr.dot(ds.d, ds.n) < 0) & (ds.pdf > 0)
            ds.emitter = mi.EmitterPtr(self) if is_jit() else self
            weight = dr.rcp(dr.maximum(ds.pdf, 1e-20))
            return ds, dr.select(active, mi.Spectrum(self.radiance) * weight, 0)

        def pdf_direction(self, it, ds, active):
            front = dr.dot(ds.d, ds.n) < 0
            return dr.select(front, self.get_shape().pdf_direction(it, ds, active), 0)

    mi.register_emitter("python_area", Area)


@VARIANTS
@pytest.mark.parametrize("shape", ["sphere", "rectangle"])
def test_area_light_in_python(variant, shape):
    """On a quadric and on a mesh."""
    register_area()
    place = transform().translate(POSITION).rotate([1, 0, 0], 180).scale(0.4)
    lamp = {"type": shape, "to_world": place}
    found = images({**lamp, "emitter": {"type": "python_area"}}, 20, "manylights_direct")
    own = {**lamp, "emitter": light_scenes.area(rgb(INTENSITY))}
    tools.assert_same_mean(found, images(own, 20, "manylights_direct"), bias=BIAS)


def register_texture(varying):
    """A texture with nothing but its value."""

    class Colour(mi.Texture):
        def eval(self, si, active=True):
            return mi.Color3f(*INTENSITY)

        def is_spatially_varying(self):
            return varying

        def sample_position(self, sample, active=True):
            return sample, mi.Float(1)

        def pdf_position(self, p, active=True):
            return mi.Float(1)

        def to_string(self):
            return "Colour[]"

    mi.register_texture(f"python_colour_{varying}", Colour)


@VARIANTS
@pytest.mark.parametrize("varying", [False, True])
def test_radiance_texture_in_python(variant, varying):
    """On a mesh, whether it says that it varies or not."""
    register_texture(varying)
    place = transform().translate(POSITION).rotate([1, 0, 0], 180).scale(0.4)
    lamp = {"type": "rectangle", "to_world": place}
    radiance = {"type": f"python_colour_{varying}"}
    found = images({**lamp, "emitter": light_scenes.area(radiance)}, 20, "manylights_direct")
    own = {**lamp, "emitter": light_scenes.area(rgb(INTENSITY))}
    tools.assert_same_mean(found, images(own, 20, "manylights_direct"), bias=BIAS)

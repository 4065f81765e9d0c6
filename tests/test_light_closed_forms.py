"""Irradiance of single lights in closed form, or by quadrature in numpy: every kind and side.

A camera looks at a small white patch under the light, so that the image is irradiance over pi.
"""

import mitsuba as mi
import numpy as np
import pytest

from tests import statistics_tools as tools
from tests.light_scenes import rgb, transform

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)

RADIANCE = (3.0, 2.0, 1.0)
NULL = {"type": "null"}
SEEDS = 16


def patch(**lights):
    """A white patch at the origin that faces +z, seen from below the lights, and a clear medium.

    Because of the medium, which is out of sight, surfaces without a BSDF let shadow rays through.
    """
    film = {
        "type": "hdrfilm",
        "width": 4,
        "height": 4,
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}
    white = {"type": "diffuse", "reflectance": rgb([1, 1, 1])}
    return {
        "type": "scene",
        "patch": {"type": "rectangle", "to_world": transform().scale(1e-3), "bsdf": white},
        "elsewhere": {
            "type": "sphere",
            "center": [0, 0, -1e3],
            "bsdf": NULL,
            "interior": fog,
        },
        "sensor": {
            "type": "perspective",
            "fov": 0.05,
            "near_clip": 1e-4,
            "to_world": transform().look_at([0.05, 0, 0.02], [0, 0, 0], [0, 0, 1]),
            "film": film,
        },
        **lights,
    }


def emitter(**shape):
    """A shape that emits `RADIANCE`."""
    return {**shape, "emitter": {"type": "area", "radiance": rgb(RADIANCE)}}


def assert_irradiance(scene, exact, integrator, spp=64, bias=0.01, label=""):
    """The image is the irradiance `exact` of radiance 1, times the radiance over pi."""
    images = tools.render_seeds(mi.load_dict(scene), mi.load_dict(integrator), spp, range(SEEDS))
    expected = np.broadcast_to(exact * np.array(RADIANCE) / np.pi, (1, 4, 4, 3))
    if exact == 0:
        np.testing.assert_array_equal(images, 0, err_msg=label)
        return
    tools.assert_same_mean(images, expected, bias=bias, label=label)
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(images * (1 + 2 * bias), expected)


PATHS = {"type": "manylights_volpath", "max_depth": 2}
DIRECT = {"type": "manylights_direct"}


@VARIANTS
@pytest.mark.parametrize("inwards", [False, True])
@pytest.mark.parametrize("inside", [False, True])
def test_sphere_with_clear_border(variant, inwards, inside):
    """From outside pi (r/d)^2, on whichever side of the sphere it shines; from inside pi or 0."""
    center, radius = ([0, 0, 0.01], 1.0) if inside else ([0, 0, 2.0], 0.4)
    lamp = emitter(type="sphere", center=center, radius=radius, flip_normals=inwards, bsdf=NULL)
    exact = np.pi * (float(inwards) if inside else (radius / center[2]) ** 2)
    assert_irradiance(patch(lamp=lamp), exact, PATHS, spp=256, bias=0.05)


def test_inward_sphere_is_found_by_light_sampling(llvm):
    """Far away, where rays from the patch hardly hit it."""
    lamp = emitter(type="sphere", center=[0, 0, 2], radius=0.02, flip_normals=True, bsdf=NULL)
    assert_irradiance(patch(lamp=lamp), np.pi * 1e-4, PATHS)


def crossings(origins, directions, radius, length):
    """How often rays enter and leave the side of a cylinder around the x axis, centred at 0."""
    a = directions[:, 1] ** 2 + directions[:, 2] ** 2
    b = origins[1] * directions[:, 1] + origins[2] * directions[:, 2]
    c = origins[1] ** 2 + origins[2] ** 2 - radius**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    result = []
    for t in ((-b - root) / a, (-b + root) / a):
        x = origins[0] + t * directions[:, 0]
        result.append((b**2 > a * c) & (t > 0) & (np.abs(x) < length / 2))
    return result


@VARIANTS
@pytest.mark.parametrize("inwards", [False, True])
def test_cylinder_with_clear_border(variant, inwards):
    """Irradiance by quadrature over the hemisphere: rays that enter it, or leave it."""
    radius, length, height = 0.5, 2.0, 1.5
    count = 1000
    u, phi = np.meshgrid(
        (np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count * 2 * np.pi
    )
    sine, cosine = np.sqrt(u.ravel()), np.sqrt(1 - u.ravel())
    phi = phi.ravel()
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)
    hits = crossings((0, 0, -height), directions, radius, length)[int(inwards)]
    lamp = emitter(
        type="cylinder",
        p0=[-length / 2, 0, height],
        p1=[length / 2, 0, height],
        radius=radius,
        flip_normals=inwards,
        bsdf=NULL,
    )
    assert_irradiance(patch(lamp=lamp), np.pi * hits.mean(), PATHS, spp=256, bias=0.05)


@VARIANTS
@pytest.mark.parametrize("flipped", [False, True])
def test_disk_and_rectangle_with_clear_border(variant, flipped):
    """A coaxial disk; and, flipped with `flip_normals`, a rectangle that fills the sky."""
    down, up = transform().rotate([1, 0, 0], 180), transform()
    place = transform().translate([0, 0, 1.0])
    disk = emitter(
        type="disk", to_world=place @ (up if flipped else down) @ transform().scale(0.5), bsdf=NULL
    )
    exact = 0.0 if flipped else np.pi * 0.25 / 1.25
    assert_irradiance(patch(lamp=disk), exact, PATHS, spp=256, bias=0.03, label="disk")
    sky = emitter(
        type="rectangle",
        to_world=place @ (up if flipped else down) @ transform().scale(1e3),
        flip_normals=flipped,
        bsdf=NULL,
    )
    assert_irradiance(patch(lamp=sky), np.pi, PATHS, spp=256, bias=0.05, label="rectangle")


@VARIANTS
@pytest.mark.parametrize("bsdf_samples", [0, 1])
@pytest.mark.parametrize("ratio", [3e-1, 3e-3, 1e-3, 1e-4, 1e-6])
def test_small_far_sphere(variant, ratio, bsdf_samples):
    """pi (r/d)^2, for which Mitsuba's own light sampling is +.7 % off at r/d = .003."""
    lamp = emitter(type="sphere", center=[0, 0, 10.0], radius=10 * ratio)
    integrator = {**DIRECT, "bsdf_samples": bsdf_samples}
    scene = patch(lamp=lamp)
    bias = 0.03 if ratio > 0.1 else 1e-3
    assert_irradiance(scene, np.pi * ratio**2, integrator, bias=bias, label=f"r/d = {ratio}")


LINE = {
    "type": "irregular",
    "wavelengths": "360,541,543,547,549,830",
    "values": "0,0,90,90,0,0",
}
"""One spectral line of some nanometres."""


@pytest.mark.parametrize("variant", ["scalar_spectral", "llvm_ad_spectral"], indirect=True)
@pytest.mark.parametrize("kind", ["mesh", "sphere", "point"])
def test_spectral_lines_are_sampled(variant, kind):
    """Light sampling alone finds as much light as Mitsuba's, and weighs all lights alike."""
    lamps = {}
    for index in range(12):
        position = [index % 4 - 1.5, index // 4 - 1.0, 2.0]
        lamp = {"type": "point", "position": position, "intensity": LINE}
        if kind != "point":
            place = transform().translate(position).rotate([1, 0, 0], 180).scale(0.3)
            shape = "rectangle" if kind == "mesh" else "sphere"
            lamp = {"type": shape, "to_world": place}
            lamp["emitter"] = {"type": "area", "radiance": LINE}
        lamps[f"lamp_{index}"] = lamp
    scene = mi.load_dict(patch(**lamps))
    images = []
    for name in ("direct", "manylights_direct"):
        integrator = {"type": name, "bsdf_samples": 0}
        if name == "direct":
            integrator["emitter_samples"] = 1
        integrator = mi.load_dict(integrator)
        images.append(tools.render_seeds(scene, integrator, 1024, range(SEEDS)))
    tools.assert_same_mean(*images[::-1], bias=0.3, power_channels=[1], label=kind)
    lights = mi.traverse(integrator)["lights_in_tree"]
    assert lights == (24 if kind == "mesh" else 12)


def lamp(kind):
    """A light of each kind that shines down from a height of 30, at most .01 wide."""
    down = transform().look_at([0, 0, 30], [0, 0, 0], [1, 0, 0])
    small = transform().translate([0, 0, 30]).scale(0.005)
    return {
        "point": lambda: {"type": "point", "position": [0, 0, 30], "intensity": rgb(RADIANCE)},
        "spot": lambda: {"type": "spot", "to_world": down, "intensity": rgb(RADIANCE)},
        "rectangle": lambda: emitter(type="rectangle", to_world=down.scale(0.005)),
        "disk": lambda: emitter(type="disk", to_world=down.scale(0.005)),
        "cube": lambda: emitter(type="cube", to_world=small),
        "textured": lambda: {
            "type": "rectangle",
            "to_world": down.scale(0.005),
            "emitter": {"type": "area", "radiance": {"type": "checkerboard"}},
        },
    }[kind]()


@VARIANTS
@pytest.mark.parametrize("integrator", [DIRECT, PATHS], ids=["direct", "volpath"])
@pytest.mark.parametrize("kind", ["point", "spot", "rectangle", "disk", "cube", "textured"])
def test_far_lamp_does_not_shine_through_its_shade(variant, kind, integrator):
    """A shade .02 below the lamp, which is less than a thousandth of the distance."""
    shade = {
        "type": "rectangle",
        "to_world": transform().translate([0, 0, 29.98]).scale(0.1),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb([0, 0, 0])}},
    }
    settings = {"scene": patch(lamp=lamp(kind), shade=shade), "integrator": integrator, "spp": 4}
    assert_irradiance(**settings, exact=0, label=kind)
    lit = mi.render(mi.load_dict(patch(lamp=lamp(kind))), integrator=mi.load_dict(integrator))
    assert np.mean(lit) > 0

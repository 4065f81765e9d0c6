"""Borders, grids, colours and polarizers in media, against what light through them must be.

Where Mitsuba's `volpath` is wrong as well (borders on shadow rays, extinction that is zero for a
part of the spectrum) only a closed form can tell.
"""

import mitsuba as mi
import numpy as np
import pytest

from tests import path_scenes
from tests import statistics_tools as tools
from tests.path_references import light_tree, quick_and_slow
from tests.test_path_closed_forms import assert_exact, both_variants, images_of

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

NULL = {"type": "null"}
GRIDS = ("homogeneous", "heterogeneous")


def transform():
    """An empty transformation, to be extended."""
    return mi.ScalarTransform4f()


def film(width=4, height=4):
    """A small film whose pixels do not overlap."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


def camera(origin, target, fov=0.5, up=(0, 0, 1), **more):
    """A narrow view of a target, whose rays start at its origin."""
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-6,
        "to_world": transform().look_at(list(origin), list(target), list(up)),
        "film": film(),
        **more,
    }


def wall(x, reflectance=1.0):
    """A diffuse wall across the x axis that faces the origin."""
    frame = transform().translate([x, 0, 0]).rotate([0, 1, 0], -90 if x > 0 else 90)
    bsdf = {"type": "diffuse", "reflectance": reflectance}
    return {"type": "rectangle", "to_world": frame.scale(5), "bsdf": bsdf}


def fog(kind, sigma, low, high, albedo=0.0):
    """A medium of constant extinction, one kind or the other."""
    if kind == "homogeneous":
        return {"type": "homogeneous", "sigma_t": sigma, "albedo": albedo}
    return path_scenes.heterogeneous(
        path_scenes.grid(np.full((2, 2, 2, 1), sigma), low, high), albedo, scale=1.0
    )


# ----------------------------------------------------------------------------------------- borders


@both_variants
@pytest.mark.parametrize("distance", [10, 1000])
@pytest.mark.parametrize("kind", GRIDS)
def test_shadow_ray_through_border(variant, kind, distance):
    """A lamp inside of a cube of fog, far from the wall: one unit of fog is in between."""
    sigma = 5.0 if kind == "homogeneous" else 1.0
    medium = fog(kind, sigma, (-1, -1, -1), (1, 1, 1))
    scene = {
        "type": "scene",
        "lamp": {"type": "point", "intensity": float(distance) ** 2},
        "fog": {"type": "cube", "bsdf": NULL, "interior": medium},
        "wall": wall(distance),
        "sensor": camera((0.6 * distance, 0.2 * distance, 0), (distance, 0, 0), fov=0.01),
    }
    exact = np.exp(-sigma) / np.pi
    assert_exact(images_of(scene, max_depth=2), exact, label=f"border, {kind}, {variant}")


@both_variants
def test_paths_in_dense_fog_far_from_the_origin(variant):
    """Rays start off their surface by a share of its coordinates; the fog in between counts.

    A mirror and a wall a tenth apart, 1,000 units from the origin.
    """
    place = transform().translate([1000, 500, 200])
    sigma = 5.0
    scene = {
        "type": "scene",
        "mirror": {
            "type": "rectangle",
            "to_world": place.translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.2),
            "bsdf": {"type": "conductor"},
        },
        "wall": {
            "type": "rectangle",
            "to_world": place.scale(5),
            "bsdf": {"type": "diffuse", "reflectance": 1.0},
            "emitter": {"type": "area", "radiance": 1.0},
        },
        "sensor": camera((0, 0, 0), (0, 0, 1), medium=fog("homogeneous", sigma, None, None)),
    }
    up = place.translate([0, 0, 1]).look_at([0, 0, 0], [0.001, 0, 1], [0, 1, 0])
    scene["sensor"]["to_world"] = up
    images = images_of(scene, max_depth=2)
    assert_exact(images, np.exp(-sigma * 3), label=f"mirror in fog, {variant}")


@both_variants
@pytest.mark.parametrize("kind", GRIDS)
def test_lamp_behind_the_border_of_dense_fog(variant, kind):
    """Rays go on a bit behind a border, more of it far from the origin; the fog in between counts.

    `volpath` loses 9e-5 (1 + 100) units of it: 9 %.
    """
    x, sigma, length = 100.0, 10.0, 0.2
    lamp = {"type": "area", "radiance": 1.0}
    scene = {
        "type": "scene",
        "fog": {
            "type": "cube",
            "to_world": transform().translate([x + 1, 0, 0]),
            "bsdf": NULL,
            "interior": fog(kind, sigma, (x, -1, -1), (x + 2, 1, 1)),
        },
        "lamp": {**wall(x + length, 0.0), "emitter": lamp},
        "sensor": camera((x - 1, 0, 0), (x, 0, 0)),
    }
    exact = np.exp(-sigma * length)
    assert_exact(images_of(scene, max_depth=1), exact, label=f"into fog, {kind}, {variant}")


@both_variants
def test_hidden_emitter_is_still_a_border(variant):
    """What is behind a hidden emitter is seen through the fog that it encloses."""
    medium = fog("homogeneous", 1.0, None, None)
    lamp = {"type": "area", "radiance": 1e-12}
    scene = {
        "type": "scene",
        "cube": {"type": "cube", "bsdf": NULL, "interior": medium, "emitter": lamp},
        "wall": wall(5),
        "sun": {"type": "directional", "direction": [1, 0, 0], "irradiance": np.pi},
        "sensor": camera((-5, 0, 0), (5, 0, 0)),
    }
    images = images_of(scene, max_depth=2, hide_emitters=True)
    assert_exact(images, np.exp(-4), label=f"hidden border, {variant}")


# ------------------------------------------------------------------------------------------- grids


@both_variants
@pytest.mark.parametrize("x", [2, -30])
@pytest.mark.parametrize("spectral", [True, False])
def test_grid_smaller_than_its_shape(variant, x, spectral):
    """A room is filled by a medium whose grid is elsewhere: walls look as without it."""
    scene = {"type": "scene", "wall": wall(x, 0.8), "sensor": camera((0, 0, 0), (x, 0, 0), 30)}
    for i in range(20):
        place = [0.5 * x, np.cos(i), np.sin(i)]
        scene[f"point_{i}"] = {"type": "point", "position": place, "intensity": 1.0}
    clear = images_of(scene, max_depth=2)
    medium = fog("heterogeneous", 5.0, (20, -0.5, -0.5), (21, 0.5, 0.5), 0.8)
    medium["has_spectral_extinction"] = spectral
    scene["sensor"]["medium"] = {"type": "ref", "id": "smoke"}
    inside = {"type": "ref", "id": "smoke"}
    scene["room"] = {"type": "cube", "bsdf": NULL, "interior": inside}
    scene["room"]["to_world"] = transform().scale(50)
    scene = {"type": "scene", "smoke": {**medium, "id": "smoke"}, **scene}
    assert_exact(images_of(scene, max_depth=2), clear.mean(axis=0), label=f"wall at {x}")


# ----------------------------------------------------------------------------------------- colours


def along_a_lamp(sigma, distance, offset=1.0, albedo=0.8):
    """Single scattering along a ray that passes a point lamp, by quadrature."""
    near = np.linspace(max(distance - 20, 0), distance + 20, 200_001)
    far = distance + 20 + np.geomspace(1e-3, 3e4, 100_001)
    t = np.concatenate([np.linspace(0, near[0], 100_001)[:-1], near, far])
    r = np.hypot(t - distance, offset)
    return [np.trapezoid(albedo * s * np.exp(-s * (t + r)) / (4 * np.pi * r * r), t) for s in sigma]


@both_variants
@pytest.mark.parametrize("distance", quick_and_slow([5, 300, 700], [5, 300]))
def test_fog_that_is_clear_for_one_channel(variant, distance):
    """A lamp where the fog is black for two channels and hardly there for the third."""
    sigma = (1.0, 1.0, 0.001)
    medium = {"type": "homogeneous", "sigma_t": path_scenes.rgb(sigma), "albedo": 0.8}
    scene = {
        "type": "scene",
        "lamp": {"type": "point", "position": [1, 0, distance], "intensity": 1.0},
        "sensor": camera((0, 0, 0), (0, 0, 1), fov=0.001, up=(0, 1, 0), medium=medium),
    }
    images = images_of(scene, max_depth=2)
    exact = np.array(along_a_lamp(sigma, distance))
    seen = exact > 1e-6 * exact.max()
    assert_exact(images[..., seen], exact[seen], label=f"third channel, {variant}")


@pytest.mark.parametrize("variant", ["scalar_spectral"], indirect=True)
def test_white_fog_of_one_part_of_the_spectrum(variant):
    """Fog without absorption under a white sky cannot be seen, whatever its extinction."""
    extinction = {"type": "regular", "wavelength_min": 360, "wavelength_max": 830}
    extinction["values"] = "0, 0, 0, 0, 0, 0.3, 0.3, 0.3, 0.3, 0.3"
    medium = {"type": "homogeneous", "sigma_t": extinction, "albedo": 1.0}
    scene = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1, 1, 1]}},
        "fog": {"type": "sphere", "bsdf": NULL, "interior": medium},
        "sensor": camera((0, 0, 5), (0, 0, 0), fov=10, up=(0, 1, 0)),
    }
    images, bare = (
        tools.render_seeds(
            mi.load_dict(each), light_tree(rr_depth=100), spp=1 << 12, seeds=range(16)
        )
        for each in (scene, {k: v for k, v in scene.items() if k != "fog"})
    )
    tools.assert_same_mean(images, bare, label="white fog")


@pytest.mark.parametrize(
    "variant, kind",
    [("scalar_rgb", "homogeneous"), ("llvm_ad_rgb", "heterogeneous")],
    indirect=["variant"],
)
def test_colourful_fog_of_many_collisions(variant, kind):
    """White fog under a white sky: weights stay small, however many collisions a path has.

    No weight exceeds the three channels. Where each step chose its channel anew they grew from
    step to step, and samples had a standard deviation of 9.
    """
    sigma, spp = (0.5, 2.0, 4.0), 640
    grid = path_scenes.grid(np.broadcast_to(sigma, (2, 2, 2, 3)), (-1, -1, -1), (1, 1, 1))
    color = path_scenes.rgb([0.1 * value for value in sigma])
    medium = {
        "homogeneous": {"type": "homogeneous", "sigma_t": color, "scale": 10.0, "albedo": 1.0},
        "heterogeneous": path_scenes.heterogeneous(grid, 1.0, scale=1.0),
    }[kind]
    scene = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": 1.0},
        "fog": {"type": "cube", "bsdf": NULL, "interior": medium},
        "sensor": camera((0, 0, 5), (0, 0, 0), fov=5, up=(0, 1, 0)),
    }
    loaded = mi.load_dict(scene)
    images = tools.render_seeds(loaded, light_tree(rr_depth=1000), spp=spp, seeds=range(64))
    assert_exact(images, 1.0, label=f"{kind}, {variant}")
    assert (images.std(axis=(0, 1, 2)) * np.sqrt(spp) < 2.5).all()


# --------------------------------------------------------------------------- what need not be noise


@both_variants
def test_last_piece_is_not_a_coin_flip(variant):
    """Emission behind fog at the last depth has a known transmittance: no noise."""
    scene = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": 1.0},
        "fog": {"type": "cube", "bsdf": NULL, "interior": fog("homogeneous", 0.5, None, None, 0.5)},
        "sensor": {
            "type": "orthographic",
            "to_world": transform().look_at([0, 0, -3], [0, 0, 0], [0, 1, 0]).scale(0.3),
            "film": film(),
        },
    }
    image = np.array(mi.render(mi.load_dict(scene), integrator=light_tree(max_depth=1), spp=1))
    assert np.allclose(image, np.exp(-1), rtol=1e-5)


@both_variants
def test_absorbing_fog_is_not_a_coin_flip(variant):
    """The same at any depth where nothing can be scattered."""
    scene = {
        "type": "scene",
        "wall": {**wall(3), "emitter": {"type": "area", "radiance": 1.0}},
        "sensor": camera((0, 0, 0), (3, 0, 0), medium=fog("homogeneous", 0.5, None, None)),
    }
    image = np.array(mi.render(mi.load_dict(scene), integrator=light_tree(max_depth=4), spp=1))
    assert np.allclose(image, np.exp(-1.5), rtol=1e-4)


@both_variants
def test_shadow_rays_have_numbers_of_their_own(variant):
    """Four equal lamps behind smoke: as tracked rays are independent, a quarter of the variance.

    The ratio of two sample variances follows F; with shared numbers it would be four times as
    large, which the same threshold must reject.
    """
    from scipy import stats

    def brightness(count, size=20):
        medium = fog("heterogeneous", 0.2, (-2, -2, -2), (2, 2, 2))
        scene = {
            "type": "scene",
            "smoke": {
                "type": "cube",
                "to_world": transform().scale(2),
                "bsdf": NULL,
                "interior": medium,
            },
            "floor": {
                "type": "rectangle",
                "to_world": transform().translate([0, 0, -2.5]).scale(5),
            },
            # All pixels show the same place
            "sensor": camera((2.4, 0, -2.3), (0, 0, -2.5), fov=0.01),
        }
        scene["sensor"]["film"] = film(size, size)
        for i in range(count):
            a = 2 * np.pi * i / count
            place = [np.cos(a), np.sin(a), 0]
            scene[f"lamp_{i}"] = {"type": "point", "position": place, "intensity": 1 / count}
        images = tools.render_seeds(mi.load_dict(scene), light_tree(max_depth=2), spp=32, seeds=[0])
        return images.mean(axis=-1).ravel()

    one, four = brightness(1), brightness(4)
    ratio = 4 * four.var(ddof=1) / one.var(ddof=1)
    low, high = stats.f.ppf([1e-5, 1 - 1e-5], len(four) - 1, len(one) - 1)
    assert low < ratio < high
    assert not low < 4 * ratio < high


@both_variants
def test_segment_of_no_length(variant):
    """A camera on a border of fog sees the scattering of the piece behind it, and no more."""
    distance = 1.0
    medium = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5, "id": "fog"}
    inside = {"type": "ref", "id": "fog"}
    border = {"type": "disk", "bsdf": NULL, "interior": inside, "exterior": inside}
    scene = {
        "type": "scene",
        "fog": medium,
        "border": border,
        "lamp": {"type": "point", "position": [1, 0, distance], "intensity": 1.0},
        "sensor": camera((0, 0, 0), (0, 0, 1), fov=0.001, up=(0, 1, 0), medium=inside),
    }
    # From the start of a ray on, near planes included
    scene["sensor"]["near_clip"] = 1e-12
    exact = along_a_lamp((1.0,), distance, albedo=0.5)[0]
    assert_exact(images_of(scene, max_depth=2), exact, label=f"no length, {variant}")


# --------------------------------------------------------------------------------------- polarizers


@pytest.mark.parametrize("variant", ["llvm_ad_mono_polarized"], indirect=True)
def test_polarizer_before_a_surface_at_brewsters_angle(variant):
    """f T E: light whose polarization the surface does not reflect is lost, the other is not.

    Both directions together let as much through as no polarizer. Only where there are media shadow
    rays pass it.
    """
    angle = np.arctan(1.5)
    sine, cosine = float(np.sin(angle)), float(np.cos(angle))
    coat = {"type": "pplastic", "alpha": 0.05, "int_ior": 1.5, "diffuse_reflectance": 0}

    def render(theta):
        scene = {
            "type": "scene",
            "lamp": {"type": "point", "position": [-10 * sine, 0, 10 * cosine], "intensity": 100.0},
            "pane": {"type": "rectangle", "bsdf": coat},
            "sensor": camera((10 * sine, 0, 10 * cosine), (0, 0, 0)),
        }
        scene["sensor"]["medium"] = fog("homogeneous", 0.001, None, None)
        if theta is not None:
            frame = transform().look_at([-sine, 0, cosine], [0, 0, 0], [0, 1, 0])
            scene["sheet"] = {
                "type": "rectangle",
                "to_world": frame.scale(0.5),
                "bsdf": {"type": "polarizer", "theta": theta},
            }
        return images_of(scene, max_depth=2)

    free, upright, flat = (render(theta) for theta in (None, 0.0, 90.0))
    tools.assert_same_mean(free, upright + flat, label="both polarizers together")
    weak, strong = sorted([upright.mean(), flat.mean()])
    assert weak < 0.01 * strong


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_slanted_ray_through_a_slab(variant):
    """Two borders move a ray aside, and the light of a point keeps its length in between."""
    extinction, thickness, light = 20.0, 0.16, np.array([2.5, 0.3, 1.0])
    fog = {"type": "homogeneous", "sigma_t": extinction, "albedo": 0.0}
    to_world = mi.ScalarTransform4f().translate([0, 0, 0.2]).scale([8, 8, thickness / 2])
    slab = {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}}
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle"},
        "light": {"type": "point", "position": light.tolist()},
        "sensor": {
            "type": "radiancemeter",
            "origin": [0, 0, 0.05],
            "direction": [0, 0, -1],
            "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}},
        },
    }
    integrator = mi.load_dict({"type": "manylights_volpath", "max_depth": 2})
    clear, dim = (
        np.array(mi.render(mi.load_dict(scene | slabs), integrator=integrator, spp=4)).mean()
        for slabs in ({}, {"slab": {**slab, "interior": fog}})
    )
    length = thickness * np.linalg.norm(light) / light[2]
    assert dim / clear == pytest.approx(np.exp(-extinction * length), rel=3e-4)

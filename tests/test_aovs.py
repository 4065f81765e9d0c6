"""Channels that describe the surfaces in sight: the parameter `aovs` of both integrators."""

import drjit as dr
import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights.errors import UsageError
from manylights.loading import ours
from manylights.loading.load import load_description
from manylights.output import channels, exr

from tests.conftest import require_variant

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
PLUGINS = ("manylights_direct", "manylights_volpath")
TYPES = (
    *("depth", "position", "uv", "geo_normal", "sh_normal"),
    *("dp_du", "dp_dv", "duv_dx", "duv_dy", "prim_index"),
)
ALL = ",".join(f"{kind}:{kind}" for kind in (*TYPES, "albedo"))
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}


@pytest.fixture(params=VARIANTS)
def variant(request):
    return require_variant(request.param)


def box(**parts):
    """A camera at the origin that looks along z, a lamp behind it, and other parts."""
    camera = {
        **{"type": "perspective", "fov": 60, "to_world": mi.ScalarTransform4f()},
        "film": {"type": "hdrfilm", "width": 16, "height": 12, "component_format": "float32"},
        "sampler": {"type": "manylights_sobol", "sample_count": 4},
    }
    lamp = {"type": "point", "position": [0.5, 1, -0.5], "intensity": 5.0}
    return {"type": "scene", "camera": camera, "lamp": lamp, **parts}


def wall(z, bsdf=GREY, size=20.0, flip=True):
    """A rectangle across the view that faces the camera."""
    to_world = mi.ScalarTransform4f().translate([0, 0, z]).scale(size)
    if flip:
        to_world = to_world @ mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def objects():
    """Surfaces of several kinds and materials, with a bump, and an instance."""
    heights = np.random.default_rng(1).random((8, 8, 1), dtype=np.float32)
    bumps = {"type": "bitmap", "bitmap": mi.Bitmap(heights), "raw": True}
    shift = mi.ScalarTransform4f
    return box(
        wall=wall(6, size=3.0),
        ball={"type": "sphere", "center": [-1, 0, 4], "radius": 0.8, "bsdf": GREY},
        bumpy={
            "type": "cube",
            "to_world": shift().translate([1, 0, 4]).rotate([1, 1, 0], 30).scale(0.6),
            "bsdf": {"type": "bumpmap", "scale": 0.2, "a": bumps, "nested": {"type": "plastic"}},
        },
        group={"type": "shapegroup", "disk": {"type": "disk", "bsdf": GREY}},
        copy={
            "type": "instance",
            "to_world": shift().translate([0, 1.4, 3]).rotate([1, 0, 0], 160).scale(0.5),
            "group": {"type": "ref", "id": "group"},
        },
        glow={
            **wall(5, size=0.3),
            "to_world": shift().translate([0, -1, 3]).rotate([0, 1, 0], 180).scale(0.3),
            "emitter": {"type": "area"},
        },
    )


def values(scene, integrator, count=24):
    """The channels of rays over the view, shape (rays, channels)."""
    rows = np.stack(np.meshgrid(*[(np.arange(count) + 0.37) / count] * 2), -1).reshape(-1, 2)
    sensor, sampler = scene.sensors()[0], scene.sensors()[0].sampler()

    def along(x, y):
        ray, _ = sensor.sample_ray_differential(0.0, 0.5, [x, y], [0.5, 0.5])
        return integrator.sample(scene, sampler, ray)[2]

    if mi.variant().startswith("scalar"):
        sampler.seed(0)
        return np.array([along(*row) for row in rows], np.float64)
    sampler.seed(0, len(rows))
    found = along(*(mi.Float(np.ascontiguousarray(rows[:, i])) for i in range(2)))
    shape = len(rows)
    return np.stack([np.broadcast_to(np.array(one), shape) for one in found], -1).astype(float)


def albedo(*parts, plugin="manylights_direct", **named):
    """The mean albedo of a view."""
    scene = mi.load_dict(box(**named))
    found = values(scene, mi.load_dict({"type": plugin, "aovs": "a:albedo"}), 64)
    return found.mean(axis=0)


# ------------------------------------------------------------------------- against Mitsuba's


@pytest.mark.parametrize("plugin", PLUGINS)
def test_channels_are_those_of_mitsuba(plugin, variant):
    scene = mi.load_dict(objects())
    ours = mi.load_dict({"type": plugin, "aovs": ALL})
    theirs = mi.load_dict({"type": "aov", "aovs": ALL})
    assert ours.aov_names() == theirs.aov_names()
    # Mitsuba's partials are no numbers where nothing is met
    found, wanted = values(scene, ours), np.nan_to_num(values(scene, theirs))
    for index, name in enumerate(ours.aov_names()):
        assert np.ptp(wanted[:, index]) > 0 or name.startswith("albedo"), name
        np.testing.assert_array_equal(found[:, index], wanted[:, index], err_msg=name)


@pytest.mark.parametrize("spectra", ["scalar_spectral", "llvm_ad_mono_polarized"])
def test_albedo_is_that_of_mitsuba_in_all_spectra(spectra):
    require_variant(spectra)
    scene = mi.load_dict(objects())
    found, wanted = (
        values(scene, mi.load_dict({"type": plugin, "aovs": "a:albedo"}))
        for plugin in ("manylights_volpath", "aov")
    )
    np.testing.assert_allclose(found, np.clip(wanted, 0, None), rtol=1e-5, atol=1e-6)
    assert np.ptp(found) > 0.3


def test_a_wrong_channel_would_be_seen(variant):
    scene = mi.load_dict(objects())
    ours = mi.load_dict({"type": "manylights_direct", "aovs": "n:geo_normal"})
    theirs = mi.load_dict({"type": "aov", "aovs": "n:sh_normal"})
    assert (values(scene, ours) != values(scene, theirs)).any()


def test_shapes_have_the_numbers_of_their_order(variant):
    """Where Mitsuba does not make one mesh of several: those come in any order."""
    scene = mi.load_dict(objects(), optimize=False)
    found = values(scene, mi.load_dict({"type": "manylights_direct", "aovs": "s:shape_index"}))
    ids = ["", *[shape.id() for shape in scene.shapes()]]
    seen = {ids[int(number)] for number in np.unique(found)}
    assert seen == {"", "wall", "ball", "bumpy", "copy", "glow"}
    require_variant("scalar_rgb")
    scene = mi.load_dict(objects(), optimize=False)
    theirs = mi.load_dict({"type": "aov", "aovs": "s:shape_index"})
    np.testing.assert_array_equal(found, values(scene, theirs))


def test_shapes_of_another_scene_have_its_numbers(variant):
    integrator = mi.load_dict({"type": "manylights_direct", "aovs": "s:shape_index"})
    for z in (3, 5):
        scene = mi.load_dict(objects())
        alone = mi.load_dict(box(wall=wall(z)))
        assert set(np.unique(values(alone, integrator))) == {1.0}
        assert len(np.unique(values(scene, integrator))) == 6


# ------------------------------------------------------------------------------ closed forms


def test_a_ball_is_where_it_is(variant):
    center, radius = np.array([0, 0, 4.0]), 3.0
    scene = box(ball={"type": "sphere", "center": center, "radius": radius, "bsdf": GREY})
    kinds = "p:position,n:sh_normal,d:depth,a:albedo"
    integrator = mi.load_dict({"type": "manylights_volpath", "aovs": kinds})
    found = values(mi.load_dict(scene), integrator)
    p, n, depth, color = found[:, :3], found[:, 3:6], found[:, 6], found[:, 7:]
    np.testing.assert_allclose(np.linalg.norm(p - center, axis=1), radius, rtol=1e-5)
    np.testing.assert_allclose(n, (p - center) / radius, atol=1e-5)
    # Rays start at the plane of the near clip
    start = 0.01 * np.linalg.norm(p, axis=1) / p[:, 2]
    np.testing.assert_allclose(depth, np.linalg.norm(p, axis=1) - start, rtol=1e-5)
    np.testing.assert_allclose(color, np.broadcast_to([0.2, 0.4, 0.6], color.shape), rtol=1e-6)


MIRROR = {"type": "conductor", "material": "none"}
MIRROR["specular_reflectance"] = {"type": "rgb", "value": [0.5, 0.25, 1.0]}
SMOOTH = {"type": "principled", "metallic": 1.0, "roughness": 0.0}
SMOOTH["base_color"] = {"type": "rgb", "value": [0.5, 0.25, 1.0]}


@pytest.mark.parametrize("plugin", PLUGINS)
def test_albedo_is_that_in_the_mirror(plugin, variant):
    parts = {"mirror": wall(4, MIRROR), "behind": wall(-3, flip=False)}
    found = albedo(plugin=plugin, **parts)
    np.testing.assert_allclose(found, [0.1, 0.1, 0.6], rtol=1e-5)


def test_albedo_is_that_in_a_mirror_of_a_narrow_lobe(variant):
    """Metal without roughness has a factor next to 1 for masking, and more at grazing angles."""
    found = albedo(mirror=wall(4, SMOOTH), behind=wall(-3, flip=False))
    np.testing.assert_allclose(found, [0.1, 0.1, 0.6], atol=0.02)


@pytest.mark.parametrize("glass", ["dielectric", "thindielectric", "null", "holes"])
def test_albedo_is_that_behind_glass(glass, variant):
    """All around is the same, so that it does not matter where a ray goes."""
    bsdf = {"type": glass}
    if glass == "holes":
        bsdf = {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse", "reflectance": 0.9}}
    ball = {"type": "sphere", "center": [0, 0, 4], "radius": 1.5, "bsdf": bsdf}
    around = {"type": "sphere", "radius": 10, "flip_normals": True, "bsdf": GREY}
    found = albedo(plugin="manylights_volpath", ball=ball, around=around)
    # Some rays meet more surfaces than are looked through
    np.testing.assert_allclose(found, [0.2, 0.4, 0.6], rtol=2e-3)


def test_half_of_a_hole_is_half_of_what_is_behind(variant):
    bsdf = {"type": "mask", "opacity": 0.25, "nested": {"type": "diffuse", "reflectance": 0.8}}
    found = albedo(hole=wall(3, bsdf), behind=wall(5))
    exact = 0.25 * 0.8 + 0.75 * np.array([0.2, 0.4, 0.6])
    spread = np.sqrt(0.25 * 0.75) * np.abs(0.8 - np.array([0.2, 0.4, 0.6]))
    # Significance 1e-6 for each of three channels
    assert (np.abs(found - exact) < 5.1 * spread / 64).all()


def test_plastic_has_the_albedo_of_what_is_under_it(variant):
    plastic = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}
    found = albedo(wall=wall(4, plastic), behind=wall(-3, {"type": "diffuse"}, flip=False))
    np.testing.assert_allclose(found, [0.2, 0.4, 0.6], rtol=1e-6)


def test_rough_metal_has_what_it_reflects(variant):
    """Between 0 and 1, where Mitsuba's `aov` shows its highlight."""
    metal = {"type": "roughconductor", "material": "none", "alpha": 0.4}
    found = albedo(wall=wall(4, metal))
    assert (found > 0.85).all() and (found <= 1.0).all()


def test_lamps_in_sight_have_their_radiance(variant):
    lamp = wall(3, size=0.5)
    lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}
    scene = mi.load_dict(box(lamp=lamp, sky=sky, wall={**wall(5, size=1.0), "bsdf": GREY}))
    for plugin in PLUGINS:
        integrator = mi.load_dict({"type": plugin, "aovs": "e:emission,d:depth"})
        found = values(scene, integrator)
        distance = found[:, 3]
        exact = np.select(
            [distance[:, np.newaxis] == 0, distance[:, np.newaxis] < 4],
            [[0.1, 0.2, 0.3], [3.0, 2.0, 1.0]],
        )
        assert len(np.unique(exact[:, 0])) == 3
        np.testing.assert_allclose(found[:, :3], exact, rtol=1e-6)
        hiding = mi.load_dict({"type": plugin, "aovs": "e:emission", "hide_emitters": True})
        assert not values(scene, hiding).any()


def test_hidden_lamps_are_not_in_sight(variant):
    scene = box(wall=wall(5), lamp={**wall(3, size=0.5), "emitter": {"type": "area"}})
    for plugin in PLUGINS:
        settings = {"type": plugin, "aovs": "p:position,a:albedo", "hide_emitters": True}
        found = values(mi.load_dict(scene), mi.load_dict(settings))
        np.testing.assert_allclose(found[:, 2], 5.0, rtol=1e-5)
        np.testing.assert_allclose(found[:, 3], 0.2, rtol=1e-6)


def test_nothing_in_sight_is_zero(variant):
    found = values(mi.load_dict(box()), mi.load_dict({"type": PLUGINS[0], "aovs": ALL}))
    assert not found.any()


# --------------------------------------------------------------------------------- the image


@pytest.mark.parametrize("plugin", PLUGINS)
@pytest.mark.parametrize("counts", [False, True])
def test_the_image_is_the_same_with_and_without(plugin, counts, variant):
    description = objects() | {"mirror": wall(8, MIRROR)}
    images = []
    for more in ({}, {"aovs": f"{ALL},s:shape_index"}):
        integrator = mi.load_dict({"type": plugin, "counts": counts, **more})
        scene = mi.load_dict(description)
        images.append(np.array(mi.render(scene, integrator=integrator, spp=8, seed=3)))
    width = images[0].shape[2]
    assert images[1].shape[2] == width + len(mi.load_dict({"type": plugin, **more}).aov_names())
    np.testing.assert_array_equal(images[0], images[1][..., :width])
    assert np.isfinite(images[1]).all()


def test_values_are_differentiable():
    require_variant("llvm_ad_rgb")
    scene = mi.load_dict(box(wall=wall(4)))
    integrator = mi.load_dict({"type": PLUGINS[0], "aovs": "a:albedo"})
    parameters = mi.traverse(scene)
    key = next(name for name, _ in parameters if name.endswith("reflectance.value"))
    dr.enable_grad(parameters[key])
    parameters.update()
    image = mi.render(scene, parameters, integrator=integrator, spp=4)
    dr.backward(dr.sum(image[:, :, 3]))
    np.testing.assert_allclose(np.ravel(dr.grad(parameters[key])), [16 * 12, 0, 0], rtol=1e-4)


# ------------------------------------------------------------------------------ whole renders


def lamps(count=6):
    """Lamps that are merged, above a floor."""
    rows = {}
    for index in range(count):
        place = mi.ScalarTransform4f().translate([index - 2.5, 0.5, 4]).scale(0.3)
        light = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 0.1 * index, 1.0]}}
        turned = place @ mi.ScalarTransform4f().rotate([0, 1, 0], 180)
        rows[f"lamp{index}"] = {"type": "rectangle", "to_world": turned, "emitter": light}
    return box(wall=wall(6), integrator={"type": "path", "max_depth": 2}, **rows)


def test_lamps_stay_merged_where_that_changes_nothing(variant):
    names = "albedo,normal,geo_normal,position,depth,uv"
    merged = manylights.render(lamps(), aovs=names, spp=4)
    assert any("merged" in note for note in merged.notes)
    description = lamps() | {"integrator": {"type": "manylights_volpath", "max_depth": 2}}
    description["integrator"]["aovs"] = channels.aov_list(names)
    apart = np.array(mi.render(mi.load_dict(description), spp=4))
    np.testing.assert_allclose(merged.image[..., 4:], apart[..., 4:], atol=1e-5)


@pytest.mark.parametrize("aovs", ["s:shape_index", "a:albedo s:prim_index", "s:prim_index d:depth"])
def test_lists_with_indices_are_found(aovs):
    assert set(channels.INDEX_TYPES) & set(channels.aov_types(aovs))
    assert not set(channels.INDEX_TYPES) & set(channels.aov_types("a:albedo, d:depth n:uv"))


@pytest.mark.parametrize("name", ["shape_index", "prim_index"])
def test_lamps_are_apart_where_they_are_counted(name, variant):
    found = manylights.render(lamps(), aovs=name, spp=1)
    assert not any("merged" in note for note in found.notes)
    numbers = np.unique(found.image[..., -1].round(3))
    assert len(numbers) >= (7 if name == "shape_index" else 2)


def test_layers_have_the_names_that_compositors_expect(tmp_path):
    require_variant("scalar_rgb")
    out = tmp_path / "a.exr"
    manylights.render(
        {**objects(), "integrator": {"type": "manylights_direct", "counts": True}},
        output=out,
        spp=2,
        aovs=["albedo", "normal", "position", "depth", "uv", "shape_index", "x:geo_normal"],
    )
    planes, attributes = exr.read(out)
    layers = {"albedo": "RGB", "normal": "XYZ", "P": "XYZ", "uv": "UV", "x": "XYZ"}
    expected = {f"{name}.{letter}" for name, letters in layers.items() for letter in letters}
    expected |= {"R", "G", "B", "Z", "shape_index.I", "samples"}
    expected |= {f"counts.{name}" for name in ("candidates", "node_visits", "expected")}
    assert set(planes) == expected
    assert all(plane.dtype == np.float32 for plane in planes.values())
    assert (planes["samples"] == 2).all()
    distance = np.sqrt(sum(planes[f"P.{axis}"] ** 2 for axis in "XYZ"))
    inside = planes["shape_index.I"] == 1
    np.testing.assert_allclose(planes["Z"][inside], distance[inside], rtol=0.01)
    assert "albedo:albedo" in attributes["manylights.parameters"]


def test_parts_and_interruptions_keep_the_layers(tmp_path):
    require_variant("scalar_rgb")
    scene, names = box(wall=wall(4)), "albedo,depth"
    manylights.render(scene, output=tmp_path / "a.exr", spp=4, aovs=names)
    parts = []
    for number in (1, 2):
        result = manylights.render(
            scene, output=tmp_path / "b.exr", spp=4, aovs=names, part=(number, 2)
        )
        parts += result.files
    manylights.merge(parts, tmp_path / "b.exr")
    whole, merged = (exr.read(tmp_path / name)[0] for name in ("a.exr", "b.exr"))
    assert set(whole) == set(merged)
    for name, plane in whole.items():
        np.testing.assert_array_equal(plane, merged[name], err_msg=name)


# ------------------------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("aovs", "message"),
    [
        ("albedo", '"albedo", but must be pairs NAME:TYPE'),
        ("a:albdo", '"a:albdo", but must be .* "albedo" or "depth"'),
        (":albedo", '":albedo", but must be pairs'),
        ("a:albedo,a:depth", r'of names that differ \("a"\)'),
    ],
)
@pytest.mark.parametrize("plugin", PLUGINS)
def test_bad_lists_are_named(aovs, message, plugin):
    require_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": plugin, "aovs": aovs})


def test_an_empty_list_is_none():
    require_variant("scalar_rgb")
    for aovs in ({}, {"aovs": ""}):
        assert mi.load_dict({"type": PLUGINS[0], **aovs}).aov_names() == []


@pytest.mark.parametrize(
    ("names", "message"),
    [("albedo,nomal", "aovs 'nomal': must be one of albedo, normal"), ("depth,depth", "twice")],
)
def test_unknown_names_and_duplicates_are_named(names, message):
    require_variant("scalar_rgb")
    with pytest.raises(UsageError, match=message):
        manylights.render(box(), aovs=names)


def test_other_integrators_and_made_scenes_have_none():
    require_variant("scalar_rgb")
    with pytest.raises(UsageError, match="aovs: path shows no surfaces, manylights_direct or"):
        manylights.render({**box(), "integrator": {"type": "path"}}, aovs="uv", integrator="keep")
    for scene in (mi.load_dict(box()), load_description(box())):
        with pytest.raises(UsageError, match="aovs: the scene is made already"):
            manylights.render(scene, aovs="albedo")


@pytest.mark.parametrize("settings", [{"counts": True}, {"aovs": "a:albedo"}])
def test_films_with_bands_of_their_own_refuse_channels(settings):
    require_variant("scalar_spectral")
    band = {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}
    scene = box()
    scene["camera"] = {**scene["camera"], "film": {"type": "specfilm", "band": band}}
    integrator = mi.load_dict({"type": PLUGINS[0], **settings})
    with pytest.raises(RuntimeError, match=r"SpecFilm.*has bands of its own"):
        mi.render(mi.load_dict(scene), integrator=integrator, spp=1)


def test_the_help_lists_what_can_be_asked_for():
    known = {kind for _, kind in channels.AOVS.values()}
    assert all(kind in ours.AOVS.allowed for kind in known)

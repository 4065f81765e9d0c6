"""The generated scenes and the XML scenes: complete, deterministic, loadable."""

import re
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import loading, scenes
from manylights.lights import count_kinds
from manylights.scenes import _build

from tests.conftest import require_variant

SCENES = Path(__file__).parent.parent / "scenes"
FILES = sorted(SCENES.glob("*.xml"))
VARIANTS = ["scalar_rgb", "scalar_spectral", "llvm_ad_mono_polarized"]

#: Generators whose lights are emitters; for the others, each triangle of one mesh.
COUNTED = [name for name in scenes.names() if name != "on_emitter"]


@pytest.fixture(params=VARIANTS)
def each_variant(request):
    return require_variant(request.param)


@pytest.fixture
def scalar():
    mi.set_variant("scalar_rgb")


def light_count(description):
    return sum(count_kinds(mi.load_dict(description)).values())


def fingerprint(value):
    """Turn a scene's dictionary into nested tuples that compare by value, meshes included."""
    if isinstance(value, dict):
        return tuple((key, fingerprint(item)) for key, item in sorted(value.items()))
    if isinstance(value, mi.Object):
        parameters = mi.traverse(value)
        keys = ("vertex_positions", "faces", "face_color")
        return tuple(np.array(parameters[key]).tobytes() for key in keys if key in parameters)
    return str(value)


def test_names_are_generators():
    assert "city" in scenes.names()
    assert all(callable(getattr(manylights.scenes, name)) for name in scenes.names())


@pytest.mark.parametrize("name", COUNTED)
@pytest.mark.parametrize("count", [2, 3, 50])
def test_number_of_lights(scalar, name, count):
    assert light_count(getattr(scenes, name)(count)) == count


@pytest.mark.parametrize("name", [name for name in COUNTED if name != "bright_far"])
def test_a_single_light(scalar, name):
    assert light_count(getattr(scenes, name)(1)) == 1


@pytest.mark.parametrize("kind", ["mesh", "points", "spots", "quads", "mixed"])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 501])
def test_city_has_as_many_lights_as_asked_for(scalar, kind, count):
    expected = 2 * count if kind == "quads" else count
    assert light_count(scenes.city(count, kind=kind)) == expected


@pytest.mark.parametrize("name", scenes.names())
def test_same_seed_same_scene(scalar, name):
    generate = getattr(scenes, name)
    assert fingerprint(generate(seed=3)) == fingerprint(generate(seed=3))


@pytest.mark.parametrize(
    "name", ["city", "bulbs", "rooms", "glossy", "open_plane", "fog_open", "cut_boundary"]
)
def test_other_seed_other_scene(scalar, name):
    generate = getattr(scenes, name)
    assert fingerprint(generate(seed=3)) != fingerprint(generate(seed=4))


def test_a_million_lights(scalar):
    assert light_count(scenes.city(1_000_000)) == 1_000_000


def test_powers_of_the_city_span_decades(scalar):
    color = np.array(mi.traverse(scenes.city(20000)["lights"])["face_color"]).reshape(-1, 3)
    luminance = color.max(axis=1)
    assert luminance.min() > 0
    assert luminance.max() / luminance.min() > 1e3


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("city", {}), ("rooms", {}), ("glossy", {}), ("fog_open", {"kind": "mesh"})],
)
def test_radiance_is_the_same_in_a_texture_as_in_an_attribute(scalar, name, arguments):
    images = []
    for texture in (False, True):
        description = getattr(scenes, name)(
            3000, texture=texture, width=48, height=27, spp=8, integrator="direct", **arguments
        )
        # BSDF sampling alone, which Mitsuba supports for both.
        description["integrator"].update(emitter_samples=0, bsdf_samples=1)
        images.append(np.array(mi.render(mi.load_dict(description), seed=1)))
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("name", scenes.names())
def test_generated_scenes_render(each_variant, name):
    arguments = {} if name == "on_emitter" else {"n_lights": 40}
    description = getattr(scenes, name)(**arguments, width=24, height=16, spp=4)
    image = np.array(mi.render(mi.load_dict(description)))
    assert np.isfinite(image).all()
    assert image.mean() > 0


def test_only_noise_differs_along_the_columns_of_the_cut_boundary(scalar):
    """A twentieth of a pixel apart from their columns, pixels would differ by 0.1 % at most."""
    description = scenes.cut_boundary(30, width=40, height=20, integrator="direct")
    description["sensor"]["sampler"] = {"type": "independent"}
    scene = mi.load_dict(description)
    lights = [(np.array(e.bbox().min), mi.traverse(e)["intensity.value"]) for e in scene.emitters()]
    sensor = scene.sensors()[0]
    irradiance = np.zeros((20, 40))
    for row in range(20):
        for column in range(40):
            place = mi.Point2f((column + 0.5) / 40, (row + 0.5) / 20)
            ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
            point = np.array(scene.ray_intersect(ray).p)
            for position, intensity in lights:
                offset = position - point
                distance = np.linalg.norm(offset)
                irradiance[row, column] += np.mean(intensity) * offset[2] / distance**3
    np.testing.assert_allclose(irradiance, np.tile(irradiance[:1], (20, 1)), rtol=1e-3)
    assert np.ptp(irradiance[0]) > 0.5 * irradiance[0].mean()


FOGGY = {
    "fog_open": {"kind": "mesh", "texture": True},
    "fog_street": {"texture": True},
    "fog_rooms": {"texture": True},
}
"""Scenes in fog in the form that Mitsuba's own integrators handle."""


@pytest.mark.parametrize("name", FOGGY)
def test_mitsuba_renders_the_fog(each_variant, name):
    description = getattr(scenes, name)(
        40, **FOGGY[name], width=24, height=16, spp=4, integrator="volpath"
    )
    image = np.array(mi.render(mi.load_dict(description)))
    assert np.isfinite(image).all()
    assert image.mean() > 0


@pytest.mark.parametrize("name", FOGGY)
def test_camera_and_lights_are_in_the_fog(scalar, name):
    description = getattr(scenes, name)(200, integrator="volpath", **FOGGY[name])
    assert description["sensor"]["medium"] == description["fog_box"]["interior"]
    scene = mi.load_dict(description)
    (box,) = [shape for shape in scene.shapes() if shape.interior_medium() is not None]
    low, high = np.array(box.bbox().min), np.array(box.bbox().max)
    camera = np.array(scene.sensors()[0].world_transform() @ mi.ScalarPoint3f(0))
    places = [emitter.get_shape().bbox() for emitter in scene.emitters()]
    corners = [camera, *(np.array(end) for place in places for end in (place.min, place.max))]
    assert (low < corners).all() and (corners < high).all()


def test_thin_fog_changes_little_and_dense_fog_hides_all(scalar):
    """Fog of a mean free path of kilometres is air; of centimetres, what is seen is fog."""
    options = {"integrator": {"type": "volpath", "max_depth": 2}, "width": 24, "height": 16}
    images = []
    for description in (
        scenes.rooms(40, texture=True, **options),
        scenes.fog_rooms(40, mean_free_path=1e6, texture=True, **options),
        scenes.fog_rooms(40, mean_free_path=0.01, texture=True, **options),
    ):
        images.append(np.array(mi.render(mi.load_dict(description), spp=256)).mean())
    assert images[1] == pytest.approx(images[0], rel=0.1)
    assert images[2] < 0.01 * images[0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: scenes.city(0), "n_lights=0"),
        (lambda: scenes.bulbs(2_000_000), "n_lights=2000000"),
        (lambda: scenes.city(10, kind="lasers"), "mesh, points"),
        (lambda: scenes.bright_far(1), "from 2"),
        (lambda: scenes.glossy(10, roughness=0.0), "roughness"),
        (lambda: scenes.narrow_spots(10, cutoff=90.0), "cutoff"),
        (lambda: scenes.rooms(10, per_room=0), "per_room"),
        (lambda: scenes.fog_open(10, kind="quads"), "points, mesh"),
        (lambda: scenes.fog_open(10, mean_free_path=0.0), "mean_free_path"),
        (lambda: scenes.fog_rooms(10, g=1.0), "g=1.0"),
        (lambda: scenes.city("many"), "n_lights='many': must be an integer from 1 to 1,000,000"),
        (lambda: scenes.city(float("nan")), "n_lights=nan: must be an integer"),
        (lambda: scenes.house(10, seed=-1), "seed=-1: must be an integer of at least 0"),
        (lambda: scenes.coincident(10, seed=None), "seed=None: must be an integer"),
        (lambda: scenes.bulbs(10, width=0), "width=0: must be an integer of at least 1"),
        (lambda: scenes.bulbs(10, height=9.5), "height=9.5: must be an integer of at least 1"),
        (lambda: scenes.open_plane(10, spp="1"), "spp='1': must be an integer of at least 1"),
        (lambda: scenes.city(10, integrator=None), "integrator=None: must be the name of a plugin"),
        (lambda: scenes.glossy(10, roughness="smooth"), "roughness='smooth': must be above 0"),
        (lambda: scenes.rooms(10, per_room=None), "per_room=None: must be an integer"),
        (lambda: scenes.fog_open(10, mean_free_path="1"), "mean_free_path='1': must be above 0"),
    ],
)
def test_wrong_arguments_are_named(scalar, call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_without_variant_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setattr(_build.mi, "variant", lambda: None)
    with pytest.raises(RuntimeError, match="set_variant"):
        scenes.city(10)


def test_texels_keep_the_order_of_quads(scalar):
    radiance = np.arange(21, dtype=float).reshape(7, 3)
    uv, bitmap = _build._texels(radiance)
    center = uv.reshape(-1, 4, 2).mean(axis=1)
    pixels = np.array(bitmap)
    texture = mi.load_dict(
        {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    )
    assert pixels.shape == (3, 3, 3)
    for index, place in enumerate(center):
        si = mi.SurfaceInteraction3f()
        si.uv = place.tolist()
        np.testing.assert_allclose(texture.eval_3(si), radiance[index])


def readme_rows():
    """Return {file name: number of lights} of the table in the README."""
    text = (SCENES / "README.md").read_text()
    rows = re.findall(r"^\| `(\w+\.xml)` \|[^|]*\| (\d+) \|", text, flags=re.MULTILINE)
    return {name: int(count) for name, count in rows}


def test_readme_lists_every_file():
    assert sorted(readme_rows()) == [path.name for path in FILES]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_are_small(path):
    lines = path.read_text().splitlines()
    assert len(lines) < 200
    assert 'type="manylights_' in path.read_text()
    assert '<default name="spp"' in path.read_text()


def test_data_files_are_small():
    for path in (SCENES / "data").iterdir():
        assert path.stat().st_size < 50_000, path.name


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_load_and_have_the_lights_of_the_readme(each_variant, path):
    if "mono" in each_variant and "sky" in path.stem:
        pytest.skip("Mitsuba has no sky in monochromatic variants")
    # Any integrator does: what counts here is that the variant accepts the scene's contents.
    scene = loading.load(str(path), {"spp": "1"}, integrator="path").scene
    assert sum(count_kinds(scene).values()) == readme_rows()[path.name]

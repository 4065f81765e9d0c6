"""Light groups: layers that sum to the image, and are what their lamps alone would give; mixes."""

import itertools
import re
from types import SimpleNamespace

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import cli
from manylights.errors import UsageError
from manylights.loading.light_groups import as_text, entry_of
from manylights.output import exr, light_groups
from manylights.rendering import job, plan

from tests import statistics_tools as tools
from tests.conftest import require_variant

pytestmark = pytest.mark.usefixtures("plugin")

GROUPS = "key=lamp_[0-3],bulbs=bulb_*,sky=sky,sun=sun"

NAMES = ["bulbs", "key", "rest", "sky", "sun"]

PLUGINS = ["manylights_direct", "manylights_volpath"]


def lamps(count=8, radiance=4.0):
    """Small squares above the floor."""
    generator = np.random.default_rng(1)
    result = {}
    for index in range(count):
        place = generator.uniform([-2, 1, -2], [2, 2.5, 2])
        frame = mi.ScalarTransform4f().translate(place.tolist()).rotate([1, 0, 0], 90)
        color = (radiance * generator.uniform(0.5, 1, 3)).tolist()
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": color}}
        result[f"lamp_{index}"] = {
            "type": "rectangle",
            "to_world": frame.scale(0.3),
            "emitter": emitter,
        }
    return result


def bulbs(count=6, intensity=0.5):
    """Points."""
    places = np.random.default_rng(2).uniform([-2, 1, -2], [2, 2, 2], (count, 3)).tolist()
    return {
        f"bulb_{index}": {"type": "point", "position": place, "intensity": intensity}
        for index, place in enumerate(places)
    }


def stage(fog=False, size=(24, 16), filter_type="box", pixel_format="rgb"):
    """A floor, a mirror ball and a camera, without lights."""
    look_at = mi.ScalarTransform4f().look_at([0, 2, 6], [0, 0.7, 0], [0, 1, 0])
    floor = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(4)
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": pixel_format}
    film |= {"component_format": "float32", "rfilter": {"type": filter_type}}
    camera = {"type": "perspective", "fov": 45, "to_world": look_at, "film": film}
    scene = {
        "type": "scene",
        "camera": camera,
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7},
    }
    scene["ball"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3}
    if fog:
        scene["fog"] = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.1}
        frame = mi.ScalarTransform4f().scale(20)
        scene["air"] = {"type": "cube", "to_world": frame, "bsdf": {"type": "null"}}
        scene["air"]["interior"] = camera["medium"] = {"type": "ref", "id": "fog"}
    return scene


def all_lights():
    """Lights of all kinds that bring light in different ways."""
    sun = {"type": "directional", "direction": [1, -2, 0.3], "irradiance": 0.4}
    ball = {"type": "sphere", "center": [-1.5, 1, 0], "radius": 0.2}
    ball["emitter"] = {"type": "area", "radiance": 2.0}
    return (
        lamps()
        | bulbs()
        | {"sky": {"type": "constant", "radiance": 0.1}, "sun": sun, "ball_0": ball}
    )


def layers_of(image, names, color):
    """The layers of a colour in an image with these channels."""
    return [image[..., names.index(name)] for name in light_groups.of_color(names, color)]


def rendered(scene, parameters, spp=4, seed=1):
    """An image, and the names of its channels."""
    integrator = mi.load_dict(parameters)
    image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))
    aovs = integrator.aov_names()
    colors = {1: ["Y"], 3: ["R", "G", "B"]}[image.shape[2] - len(aovs)]
    return image, colors + aovs


# ------------------------------------------------------------------------------ Layers of mi.render


CASES = [
    *((plugin, False, {}) for plugin in PLUGINS),
    ("manylights_direct", False, {"method": "tree", "bsdf_samples": 6}),
    ("manylights_direct", False, {"method": "adaptive_splitting"}),
    ("manylights_direct", False, {"method": "exhaustive", "reservoirs": 64}),
    ("manylights_volpath", False, {"hide_emitters": True, "max_depth": 3}),
    ("manylights_volpath", True, {}),
    ("manylights_volpath", True, {"splitting_rate": 4, "counts": True}),
]


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_rgb"])
@pytest.mark.parametrize(("plugin_name", "fog", "more"), CASES)
def test_layers_sum_to_the_image_which_is_that_without(name, plugin_name, fog, more):
    require_variant(name)
    check_layers(plugin_name, fog, more)


def test_layers_are_red_green_and_blue_in_all_variants(variant):
    check_layers("manylights_volpath", False, {})


def check_layers(plugin_name, fog, more):
    """Check that layers sum to the image, which has the bits of one without layers.

    But where something is learnt, since dim groups get more samples then.
    """
    scene = mi.load_dict(stage(fog) | all_lights())
    parameters = {"type": plugin_name, **more}
    if more.get("method", "resampled_tree") == "resampled_tree":
        parameters["learn_visibility"] = False
    plain, _ = rendered(scene, parameters)
    image, names = rendered(scene, parameters | {"light_groups": GROUPS})
    assert light_groups.groups(names) == NAMES
    np.testing.assert_array_equal(image[..., : plain.shape[2]], plain)
    for color in light_groups.RGB:
        layers = layers_of(image, names, color)
        beauty = image[..., names.index(color if color in names else "Y")]
        total = light_groups.total(layers)
        np.testing.assert_allclose(total, beauty, rtol=1e-5, atol=1e-6 * beauty.max())
        assert all(layer.max() > 0 for layer in layers)


@pytest.mark.parametrize("plugin_name", PLUGINS)
def test_a_layer_is_what_its_lamps_alone_give(scalar, plugin_name):
    compare_with_lamps_alone(plugin_name, fog=False)


@pytest.mark.slow
def test_a_layer_in_fog_is_what_its_lamps_alone_give(llvm):
    compare_with_lamps_alone("manylights_volpath", fog=True, spp=1024)


def only(lights, groups, group):
    """Lights of which those of other groups are off: their shapes are left."""
    result = {}
    for name, light in lights.items():
        if entry_of(groups, name) == {"key": 0, "bulbs": 1, "rest": None}[group]:
            result[name] = light
        elif "emitter" in light:
            result[name] = {key: part for key, part in light.items() if key != "emitter"}
            result[name]["bsdf"] = {"type": "diffuse", "reflectance": 0.0}
    return result


def compare_with_lamps_alone(plugin_name, fog, spp=64):
    """Compare each layer with renders of its lamps, and with ones that are a little brighter."""
    lights, groups = all_lights(), as_text({"key": "lamp_[0-3]", "bulbs": "bulb_*"})
    parameters = {"type": plugin_name} | ({"max_depth": 4} if "volpath" in plugin_name else {})
    integrator = mi.load_dict(parameters | {"light_groups": groups})
    names = ["R", "G", "B", *integrator.aov_names()]
    scene, seeds = mi.load_dict(stage(fog) | lights), range(12)
    images = tools.render_seeds(scene, integrator, spp=spp, seeds=seeds)
    for group in ("key", "bulbs", "rest"):
        alone = mi.load_dict(stage(fog) | only(lights, groups, group))
        expected = tools.render_seeds(alone, mi.load_dict(parameters), spp, range(100, 112))
        layer = images[..., [names.index(f"RGBA_{group}.{color}") for color in "RGB"]]
        tools.assert_same_mean(layer, expected, bias=0.1, label=group)
        assert not tools.compare_means(layer * 1.1, expected).passes, group


def test_a_lamp_belongs_to_the_first_entry_that_fits_its_id_or_that_of_its_shape(scalar):
    lights = bulbs(2)
    lights["a"] = lamps(1, radiance=1e4)["lamp_0"]
    lights["a"]["emitter"]["id"] = "b"
    scene = mi.load_dict(stage() | lights)
    for groups, group in (("x=a", "x"), ("x=b", "x"), ("y=bulb_*,x=*", "x"), ("y=?,x=*", "y")):
        parameters = {"type": "manylights_direct", "light_groups": groups}
        image, names = rendered(scene, parameters)
        lit = {
            name: image[..., names.index(f"RGBA_{name}.R")].max() > 10
            for name in ("x", "y")
            if name in groups
        }
        assert [name for name in lit if lit[name]] == [group], groups


def test_weights_of_a_sensor_are_part_of_the_layers(scalar):
    scene = stage() | all_lights()
    scene["camera"] = {
        "type": "distant",
        "direction": [0, -1, 0],
        "film": scene["camera"]["film"] | {"width": 1, "height": 1},
    }
    image, names = rendered(
        mi.load_dict(scene), {"type": "manylights_direct", "light_groups": GROUPS}
    )
    total = light_groups.total(layers_of(image, names, "R"))
    np.testing.assert_allclose(total, image[..., 0], rtol=1e-5)


# --------------------------------------------------------------------------------------- Mistakes


MISTAKES = [
    ("key", "entries as"),
    ("key=", "entries as"),
    ("key=a,,b=c", "entries as"),
    ("=lamp_0", "letters, digits"),
    ("a b=lamp_0", "letters, digits"),
    ("a.b=lamp_0", "letters, digits"),
    ("rest=lamp_0", '"rest"'),
    ("key=[lamp", "each \\["),
    ("key=lamp_[!]", "each \\["),
    (",".join(f"g{index}=lamp_0" for index in range(17)), "at most 16 groups"),
]


@pytest.mark.parametrize(("groups", "words"), MISTAKES)
def test_wrong_groups_are_refused_when_the_scene_is_loaded(scalar, groups, words):
    with pytest.raises(RuntimeError, match=f'"light_groups" is .*{words}'):
        mi.load_dict({"type": "manylights_volpath", "light_groups": groups})


@pytest.mark.parametrize(
    "groups", ["key=lamp", "key=lamp_0,other=lamp_0", "key=lamp_*,win=window_*"]
)
def test_a_group_without_lights_is_an_error(scalar, groups):
    entry = groups.split(",")[-1]
    with pytest.raises(
        RuntimeError, match=f'"{entry.replace("*", ".")}" matches no light.*"bulb_0"'
    ):
        rendered(
            mi.load_dict(stage() | bulbs(1) | lamps(2)),
            {"type": "manylights_direct", "light_groups": groups},
        )


NAMELESS = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="4"/><integer name="height" value="4"/>
        <string name="pixel_format" value="rgb"/>
    </film></sensor>
    <shape type="sphere"><point name="center" value="3, 0, 0"/><emitter type="area"/></shape>
    <emitter type="constant"/>
</scene>
"""


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("", "The scene has 2 lights without an id."),
        ('<emitter type="point" id="key"/>', 'has 3 lights: "key" and 2 without an id.'),
        ('<shape type="cube"><emitter type="area" id="glow"/></shape>', ': "glow" and 2 without'),
        ('<emitter type="point" id="a_{}"/>' * 9, r'has 11 lights: .*a_7", \.\.\. and 2 with'),
    ],
)
def test_lights_without_an_id_are_counted(scalar, more, words):
    more = more.format(*range(9))
    scene = mi.load_string(NAMELESS.replace("</scene>", f"{more}</scene>"))
    with pytest.raises(RuntimeError, match=words):
        rendered(scene, {"type": "manylights_direct", "light_groups": "a=lamp"})


def test_lights_without_ids_are_told(scalar, tmp_path, capsys):
    path = tmp_path / "scene.xml"
    path.write_text(NAMELESS)
    words = "light_groups key=lamp_*: no light of the scene has an id, nor has its shape, give"
    with pytest.raises(UsageError, match=re.escape(words)):
        manylights.render(path, spp=1, light_groups="key=lamp_*")
    command = ["render", str(path), "-o", str(tmp_path / "o.exr"), "--variant", "scalar_rgb"]
    assert cli.main([*command, "--light-groups", "key=lamp_*"]) == 2
    assert "manylights: --light-groups key=lamp_*: no light of the" in capsys.readouterr().err
    # All of them are a group all the same
    assert manylights.render(path, spp=1, light_groups="all=*").image.any()
    path.write_text(NAMELESS.replace('"constant"', '"constant" id="sky"'))
    assert manylights.render(path, spp=1, light_groups="key=sky").image.any()
    assert cli.main([*command, "--light-groups", "key=moon"]) == 2
    assert 'manylights: in the parameter "light_groups", "key=moon"' in capsys.readouterr().err


def test_sixteen_groups_are_allowed_and_no_lights_at_all_need_none(scalar):
    groups = ",".join(f"g{index}=lamp_{index}" for index in range(16))
    image, names = rendered(
        mi.load_dict(stage() | lamps(20)), {"type": "manylights_direct", "light_groups": groups}
    )
    total = light_groups.total(layers_of(image, names, "G"))
    np.testing.assert_allclose(total, image[..., 1], rtol=1e-5)
    assert image.shape[2] == 3 + 3 * 17


def test_patterns_fit_as_those_of_file_names():
    core = pytest.importorskip("manylights._core")
    generator = np.random.default_rng(3)
    texts = ["".join(generator.choice(list("ab-"), generator.integers(0, 6))) for _ in range(60)]
    patterns = [
        "".join(generator.choice(["a", "b", "*", "?", "[a-b]", "[!a]", "[b-]"], n))
        for n in (1, 2, 3, 4, 5)
        for _ in range(12)
    ]
    fits = 0
    for pattern, text in itertools.product(patterns, texts):
        entry, group = core.light_group(f"x={pattern}", text, "\n")
        found = entry_of(f"x={pattern}", text, "\n") if "\n" else None
        assert group == ("x" if entry == 0 else "rest")
        assert (entry == 0) == (found == 0), (pattern, text)
        fits += entry == 0
    assert fits > 100


def test_groups_can_be_a_dictionary():
    assert as_text({"key": "lamp_*", "win": ["a", "b"]}) == "key=lamp_*,win=a,win=b"
    for wrong in ({"key": []}, {"key": 3}, {"key": "a,b"}, 5):
        with pytest.raises(UsageError):
            as_text(wrong)


# ------------------------------------------------------------------------------------------- Files


def check_file(path, groups=NAMES):
    """Return channels and attributes of an image, which is the sum of its layers bit for bit."""
    planes, attributes = exr.read(path)
    assert light_groups.groups(planes) == groups
    for color in "RGB":
        total = np.zeros_like(planes[color])
        for name in [name for name in planes if name.startswith("RGBA_") and name.endswith(color)]:
            assert planes[name].dtype == np.float32
            total += planes[name]
        np.testing.assert_array_equal(total, planes[color])
    return planes, attributes


@pytest.fixture
def short_steps(monkeypatch):
    """Also small images are rendered in several steps."""
    monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", 0)
    monkeypatch.setattr(plan, "MOST_SAMPLES", dict.fromkeys(plan.MOST_SAMPLES, 2**10))


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_rgb"])
@pytest.mark.parametrize("plugin_name", PLUGINS)
def test_files_sum_bit_for_bit_also_of_merged_lamps(name, plugin_name, tmp_path):
    require_variant(name)
    scene = stage(filter_type="gaussian", pixel_format="rgba") | all_lights()
    scene["camera"]["film"]["component_format"] = "float16"
    path = tmp_path / "a.exr"
    result = manylights.render(
        scene, integrator={"type": plugin_name}, spp=4, output=path, light_groups=GROUPS
    )
    assert any("12 meshes merged" in note or "8 meshes merged" in note for note in result.notes), (
        result.notes
    )
    planes, _ = check_file(path)
    np.testing.assert_array_equal(planes["RGBA_key.A"], planes["A"])
    np.testing.assert_allclose(result.image[..., 0], planes["R"], rtol=1e-5)
    assert path.with_suffix(".png").exists()


def test_merged_lamps_stay_in_their_groups(scalar):
    scene = (
        stage()
        | lamps()
        | {"integrator": {"type": "manylights_direct", "light_groups": "a=lamp_[0-3],b=lamp_[45]"}}
    )
    merged = manylights.merge_emitters(scene)
    assert merged.merged == {
        "lamp_0": ["lamp_0", "lamp_1", "lamp_2", "lamp_3"],
        "lamp_4": ["lamp_4", "lamp_5"],
        "lamp_6": ["lamp_6", "lamp_7"],
    }
    scenes = mi.load_dict(scene), mi.load_dict(merged)
    assert len(scenes[1].emitters()) == 3
    apart, together = (np.array(mi.render(each, spp=4)) for each in scenes)
    # Three of four channels: those of a, of b, of the others
    assert (together[..., 3:].max(axis=(0, 1)) > 0).all()
    np.testing.assert_allclose(together, apart, rtol=1e-4, atol=1e-6)


def test_the_same_bits_in_parts_and_with_any_number_of_threads(scalar, tmp_path, short_steps):
    scene, groups = stage(filter_type="gaussian") | all_lights(), as_text({"key": "lamp_[0-3]"})
    options = {"spp": 16, "light_groups": groups, "output": tmp_path / "a.exr"}
    one = manylights.render(scene, threads=1, **options)
    planes, _ = check_file(tmp_path / "a.exr", ["key", "rest"])
    for number in (1, 2):
        result = manylights.render(scene, threads=2, part=(number, 2), **options)
        assert result.files[0].name == f"a.part-{number:02}-of-02.exr" or result.files
    parts = sorted(tmp_path.glob("a.part*.exr"))
    merged = manylights.merge(parts, tmp_path / "merged.exr")
    again, _ = check_file(tmp_path / "merged.exr", ["key", "rest"])
    assert planes.keys() == again.keys()
    for name, plane in planes.items():
        np.testing.assert_array_equal(plane, again[name], err_msg=name)
    assert merged.samples == one.samples
    options["light_groups"] = as_text({"key": "lamp_[0-4]"})
    (other,) = manylights.render(
        scene, part=(2, 2), **{**options, "output": tmp_path / "b.exr"}
    ).files
    with pytest.raises(UsageError, match="light_groups"):
        manylights.merge([parts[0], other])


def test_means_of_finished_images_are_the_sum_of_their_layers(scalar, tmp_path):
    scene = stage() | all_lights()
    for seed in (1, 2):
        manylights.render(
            scene, spp=2, seed=seed, output=tmp_path / f"{seed}.exr", light_groups=GROUPS
        )
    manylights.merge([tmp_path / "1.exr", tmp_path / "2.exr"], tmp_path / "mean.exr")
    check_file(tmp_path / "mean.exr")


def test_objects_and_films_without_colours_have_no_light_groups(scalar):
    scene = stage() | lamps()
    with pytest.raises(UsageError, match="light_groups: the scene is made already"):
        manylights.render(mi.load_dict(scene), light_groups="key=lamp_*")
    scene["camera"]["film"]["pixel_format"] = "luminance"
    with pytest.raises(UsageError, match=r'format y, layers need .*"pixel_format" value="rgb"/>'):
        manylights.render(scene, light_groups="key=lamp_*", spp=1)
    with pytest.raises(UsageError, match="path has none"):
        manylights.render(stage() | lamps(), integrator="path", light_groups="key=lamp_*", spp=1)


@pytest.mark.parametrize("variant", ["scalar_mono", "llvm_ad_mono", "llvm_ad_mono_polarized"])
def test_variants_without_colours_say_which_have_them(variant):
    if variant not in mi.variants():
        pytest.skip(f"Mitsuba has no {variant}")
    before = mi.variant()
    mi.set_variant(variant)
    try:
        film = mi.load_dict({"type": "hdrfilm", "pixel_format": "rgb"})
        driver = SimpleNamespace(
            integrator='light_groups = "key=lamp_*"', sensor=SimpleNamespace(film=lambda: film)
        )
        colored = variant.partition("_mono")[0] + "_rgb"
        with pytest.raises(
            UsageError, match=f"no colours in {variant}, .*the variant {colored} has"
        ):
            job._check_groups(driver)
    finally:
        mi.set_variant(before or "scalar_rgb")


# -------------------------------------------------------------------------------- Noise


def test_the_noise_of_dim_groups_is_evened_without_bias(scalar):
    # A thousandth of the light comes from every second lamp.
    lights = lamps(24, radiance=10.0)
    for name, lamp in list(lights.items())[::2]:
        lights[name.replace("lamp", "dim")] = lights.pop(name)
        lamp["emitter"]["radiance"]["value"] = [0.01, 0.01, 0.01]
    scene = mi.load_dict(stage() | lights)
    parameters = {"type": "manylights_direct", "light_groups": "dim=dim_*", "shadow_rays": 2}
    images, noises = [], []
    for learn in (False, True):
        integrator = mi.load_dict(parameters | {"learn_visibility": learn})
        dim = ["R", "G", "B", *integrator.aov_names()].index("RGBA_dim.R")
        found = tools.render_seeds(scene, integrator, spp=64, seeds=range(16))
        noises.append(found[..., dim].var(axis=0).mean())
        images.append(found[..., [0, dim]])
    assert noises[1] < 0.7 * noises[0]
    tools.assert_same_mean(*images, bias=0.2)
    assert not tools.compare_means(images[0] * 1.2, images[1]).passes


# -------------------------------------------------------------------------------------------- Mixes


@pytest.fixture
def image(scalar, tmp_path):
    """A file with layers."""
    path = tmp_path / "out.exr"
    manylights.render(
        stage(pixel_format="rgba") | all_lights(), spp=4, output=path, light_groups=GROUPS
    )
    return path


def mix(*words):
    """Run the command and return its exit status."""
    return cli.main(["mix", *map(str, words)])


def test_a_mix_is_exact(image, tmp_path):
    target = tmp_path / "mixed.exr"
    assert mix(image, "key=2", "sky=.5,.4,.3", "bulbs=0", "-o", target) == 0
    before, _ = exr.read(image)
    planes, attributes = check_file(target)
    weights = {"key": [2, 2, 2], "sky": [0.5, 0.4, 0.3], "bulbs": [0, 0, 0]}
    for group in NAMES:
        for color, weight in zip("RGB", weights.get(group, [1, 1, 1])):
            name = f"RGBA_{group}.{color}"
            np.testing.assert_array_equal(planes[name], before[name] * np.float32(weight))
    np.testing.assert_array_equal(planes["A"], before["A"])
    assert planes.keys() == before.keys()
    assert target.with_suffix(".png").exists()
    assert exr.fact(attributes["manylights.mix"])["key"] == [2, 2, 2]
    # Another one of it goes on from there
    again = tmp_path / "again.exr"
    assert mix(target, "key=.5", "-o", again) == 0
    np.testing.assert_array_equal(check_file(again)[0]["RGBA_key.R"], before["RGBA_key.R"])
    with pytest.raises(UsageError, match="mix"):
        manylights.merge([image, target])


def test_a_mix_keeps_what_it_does_not_change(scalar, tmp_path):
    """Layers of surfaces, samples, the camera; not what lamps in sight emit."""
    target, kept = tmp_path / "out.exr", "albedo,normal,depth"
    manylights.render(
        stage() | all_lights(), spp=2, output=target, light_groups=GROUPS, aovs=f"{kept},emission"
    )
    mixed = manylights.mix(target, {"key": 0}, tmp_path / "mixed.exr")
    assert mixed.notes == ["left out, since it is that of the render: emission"]
    before, told = exr.read(target)
    after, said = exr.read(tmp_path / "mixed.exr")
    assert before.keys() - after.keys() == {f"emission.{color}" for color in "RGB"}
    assert not after["RGBA_key.R"].any() and (after["R"] != before["R"]).any()
    for name in after.keys() - {"R", "G", "B", "RGBA_key.R", "RGBA_key.G", "RGBA_key.B"}:
        np.testing.assert_array_equal(after[name], before[name], err_msg=name)
    assert said.keys() - told.keys() == {"manylights.mix"} and not told.keys() - said.keys()
    for name in told:
        np.testing.assert_array_equal(told[name], said[name], err_msg=name)


def test_weights_of_one_leave_every_bit(image):
    planes, _ = exr.read(image)
    mixed = manylights.mix(image, {"key": 1.0})
    for index, color in enumerate("RGB"):
        np.testing.assert_array_equal(mixed.image[..., index], planes[color])


def test_a_mix_is_the_render_with_other_lamps(scalar, tmp_path):
    lights, path = lamps() | bulbs(), tmp_path / "a.exr"
    changed = lamps(radiance=12.0) | bulbs(intensity=0.0)
    mixes, renders = [], []
    for seed in range(8):
        manylights.render(
            stage() | lights, spp=64, seed=seed, output=path, light_groups="key=lamp_*"
        )
        mixes.append(manylights.mix(path, {"key": 3, "rest": 0}).image)
        renders.append(manylights.render(stage() | changed, spp=64, seed=seed + 50).image)
    mixes, renders = np.stack(mixes).astype(float), np.stack(renders).astype(float)
    tools.assert_same_mean(mixes, renders, bias=0.1)
    assert not tools.compare_means(mixes * 1.1, renders).passes


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("windows=2",), "no light group windows, it has bulbs, key, rest, sky, sun"),
        (("key=a",), "key=a: must be a number"),
        (("key=1,2",), "one or three finite numbers"),
        (("key=-1",), "one or three finite numbers"),
        (("key=inf",), "one or three finite numbers"),
        (("key=1e39",), "one or three finite numbers"),
        (("key",), "group key: write it as NAME=VALUE"),
        (("key=1", "key=2"), "given twice"),
    ],
)
def test_wrong_weights_are_refused(image, tmp_path, capsys, words, text):
    assert mix(image, *words, "-o", tmp_path / "mixed.exr") == 2
    assert text in capsys.readouterr().err
    assert not (tmp_path / "mixed.exr").exists()


def test_weights_of_wrong_types_are_refused(image):
    for weights in (None, "key=2", [("key", 2)]):
        with pytest.raises(UsageError, match="must be a dictionary of factors by group"):
            manylights.mix(image, weights)
    for weight in ("2", None, ["a", "b", "c"], [1, 2], np.ones(2), np.ones((3, 3)), {1: 2}):
        with pytest.raises(UsageError, match=r"^key=.*must be one or three finite numbers"):
            manylights.mix(image, {"key": weight})
    with pytest.raises(UsageError, match="path 3: must be a path"):
        manylights.mix(3, {"key": 1})
    listed = manylights.mix(image, {"key": [1, 2, 3]}).image
    for weight in (np.array([1, 2, 3]), np.array([1, 2, 3], np.float32)):
        np.testing.assert_array_equal(manylights.mix(image, {"key": weight}).image, listed)


def test_other_files_are_refused(scalar, tmp_path, capsys):
    target = tmp_path / "mixed.exr"
    foreign, plain, missing = (tmp_path / f"{name}.exr" for name in ("foreign", "plain", "missing"))
    mi.Bitmap(np.ones((4, 4, 3), np.float32)).write(str(foreign))
    manylights.render(stage() | lamps(), spp=1, output=plain)
    for path, text in (
        (foreign, "no render of manylights"),
        (plain, "no light groups"),
        (missing, "no such file"),
    ):
        assert mix(path, "key=1", "-o", target) == 2
        assert text in capsys.readouterr().err

"""The command line as users meet it, and what it is made of.

Most commands run in this process. One of each kind has its own (`manylights_process`), and so has
what needs one: limits, signals, tracebacks, files that could end it, what the shell takes.
"""

import json
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import manylights as package
import mitsuba as mi
import numpy as np
import pytest
from manylights import __version__, cli, loading, plugin_dir
from manylights.cli.main import parser
from manylights.errors import UsageError
from manylights.loading import integrators, ours
from manylights.output import exr
from manylights.progress import Estimate, format_seconds

from tests.command_line import assert_fails, manylights, manylights_process
from tests.conftest import heed_ctrl_c, require_variant

SCENES = Path(__file__).parent.parent / "scenes"

DIRECT = """<scene version="3.0.0">
    <default name="brightness" value="1"/>
    <integrator type="direct">
        <boolean name="hide_emitters" value="true"/>
        <integer name="bsdf_samples" value="2"/>
        <integer name="emitter_samples" value="3"/>
    </integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0, -5, 2" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"/>
        <film type="hdrfilm">
            <integer name="width" value="24"/>
            <integer name="height" value="16"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="sphere"/>
    <emitter type="point">
        <point name="position" value="0, -2, 3"/>
        <rgb name="intensity" value="$brightness"/>
    </emitter>
</scene>
"""


#: Parameters of Mitsuba's path tracers, as XML.
PATH_PARAMETERS = """
    <integer name="max_depth" value="6"/>
    <integer name="rr_depth" value="3"/>
    <boolean name="hide_emitters" value="true"/>
    <integer name="block_size" value="16"/>
"""
FOG = '<medium type="homogeneous" id="fog"/>'


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(DIRECT)
    return path


def render(scene, out, *arguments, command=manylights):
    result = command("render", scene, "-o", out, "--variant", "scalar_rgb", "--spp", 4, *arguments)
    assert result.returncode == 0, result.stderr
    return result


@pytest.fixture
def choose(tmp_path):
    """A function that chooses the integrator of a scene without making it.

    It takes XML and what `integrators.choose` takes; it returns the plugin's name, its parameters
    and the log.
    """
    mi.set_variant("scalar_rgb")

    def run(text, wanted=None, **settings):
        path = tmp_path / "chosen.xml"
        path.write_text(f'<scene version="3.0.0">{text}</scene>')
        state = loading.parse(str(path)).state
        notes = integrators.choose(state, wanted, settings)
        leaves = integrators.leaf_integrators(state)
        if not leaves:
            return None, {}, notes
        props = leaves[0].props
        return props.plugin_name(), dict(props.items()), notes

    return run


def integrator(plugin, parameters=""):
    """An integrator as XML."""
    return f'<integrator type="{plugin}">{parameters}</integrator>'


@pytest.mark.parametrize("name", ["manylights_direct", "manylights_volpath"])
def test_plugin_dir_holds_the_plugins(name):
    result = manylights("plugin-dir")
    assert result.returncode == 0
    folder = Path(result.stdout.strip()) / "plugins"
    assert any(path.stem == name for path in folder.iterdir())


def test_mitsuba_command_finds_the_plugin(tmp_path):
    folder = manylights_process("plugin-dir").stdout.strip()
    executable = Path(sys.executable).parent / "mitsuba"
    if not executable.exists():
        pytest.skip("Mitsuba's command is not beside the interpreter")
    out = tmp_path / "out.exr"
    arguments = ["-m", "scalar_rgb", "-a", folder, "-D", "spp=1", "-o", out]
    command = [executable, *arguments, SCENES / "points.xml"]
    subprocess.run(list(map(str, command)), check=True, capture_output=True, timeout=300)
    assert out.exists()


def test_render_writes_image_and_preview(scene, tmp_path):
    render(scene, tmp_path / "out.exr", command=manylights_process)
    assert (tmp_path / "out.exr").stat().st_size > 0
    assert (tmp_path / "out.png").stat().st_size > 0
    assert {path.name for path in tmp_path.iterdir()} == {"scene.xml", "out.exr", "out.png"}


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_same_seed_gives_the_same_bytes(scene, tmp_path, variant):
    """All of the file but the seconds that the render took; also in another process."""
    variant = require_variant(variant)
    images = []
    for index, (seed, threads) in enumerate([(5, 1), (5, 2), (6, 2)]):
        out = tmp_path / f"{index}.exr"
        arguments = ("--seed", seed, "--threads", threads, "--variant", variant)
        render(scene, out, *arguments, command=manylights_process if index == 1 else manylights)
        channels, attributes = exr.read(out)
        assert attributes.pop("manylights.seconds_taken") > 0
        seeds = attributes.pop("manylights.seed"), attributes.pop("manylights.seeds")
        pixels = {name: plane.tobytes() for name, plane in channels.items()}
        images.append((pixels, {name: str(value) for name, value in attributes.items()}, seeds))
    assert images[0] == images[1]
    assert images[0][0] != images[2][0] and images[0][1:] == (images[2][1], ("5", "[5]"))


def test_direct_is_replaced_with_its_parameters(scene, tmp_path):
    log = render(scene, tmp_path / "out.exr").stderr
    assert "direct replaced by manylights_direct" in log
    assert "hide_emitters=True" in log and "bsdf_samples=2" in log
    assert "emitter_samples=3 has no counterpart" in log


def test_keep_leaves_direct(scene, tmp_path):
    log = render(scene, tmp_path / "out.exr", "--integrator", "keep").stderr
    assert "direct replaced" not in log


def test_integrator_by_name(scene, tmp_path):
    arguments = ("--integrator", "path", "--set", "max_depth=2")
    log = render(scene, tmp_path / "out.exr", *arguments).stderr
    assert "direct replaced by path with hide_emitters=True" in log


def test_nested_direct_is_replaced_and_channels_are_kept(tmp_path):
    text = (SCENES / "aov.xml").read_text().replace("manylights_direct", "direct")
    path = tmp_path / "aov.xml"
    path.write_text(text)
    log = render(path, tmp_path / "out.exr", "-D", "resx=12", "-D", "resy=8").stderr
    assert "direct replaced by manylights_direct" in log
    fields = [field.name for field in mi.Bitmap(str(tmp_path / "out.exr")).struct_()]
    assert {"R", "G", "B", "depth.T", "normal.X"} <= set(fields)


@pytest.mark.parametrize("old", ["path", "volpath"])
def test_path_tracers_are_replaced_with_their_parameters(choose, old):
    name, parameters, notes = choose(integrator(old, PATH_PARAMETERS))
    assert name == "manylights_volpath"
    assert parameters == {"max_depth": 6, "rr_depth": 3, "hide_emitters": True, "block_size": 16}
    assert len(notes) == 1
    assert f"{old} replaced by manylights_volpath with max_depth=6" in notes[0]
    assert "keep" in notes[0] and "dropped" not in notes[0]


@pytest.mark.parametrize("old", ["path", "volpath", "volpathmis", "direct"])
def test_keep_changes_nothing(choose, old):
    name, parameters, notes = choose(integrator(old), "keep")
    assert (name, parameters, notes) == (old, {}, [])


@pytest.mark.parametrize("old", ["volpathmis", "depth", "manylights_direct", "manylights_volpath"])
def test_other_integrators_stay(choose, old):
    name, parameters, notes = choose(integrator(old))
    assert (name, parameters) == (old, {})
    assert notes[0].startswith(f"integrator: {old}")
    assert ("no spectral MIS" in notes[0]) == (old == "volpathmis")


def test_scene_without_integrator_gets_paths_with_the_tree(choose):
    name, parameters, notes = choose("")
    assert (name, parameters) == ("manylights_volpath", {})
    words = 'using manylights_volpath (integrator="NAME" takes another)'
    assert notes[0] == f"integrator: the scene names none, {words}"


def test_scene_without_integrator_can_be_kept(choose):
    name, _, notes = choose("", "keep")
    assert name is None and notes == []
    with pytest.raises(UsageError, match=r'name one \(integrator="NAME"\)'):
        choose("", "keep", max_depth=2)


def test_settings_reach_the_integrator_of_a_scene_without_one(choose):
    _, parameters, _ = choose("", max_depth=3, splitting_rate=2.0)
    assert parameters == {"max_depth": 3, "splitting_rate": 2.0}


@pytest.mark.parametrize("text", ["", integrator("path")])
def test_media_that_path_ignores_are_mentioned(choose, text):
    assert any("which path ignores" in note for note in choose(text + FOG)[2])
    assert not any("ignores" in note for note in choose(text)[2])


def test_media_of_volpath_need_no_mention(choose):
    assert not any("ignores" in note for note in choose(integrator("volpath") + FOG)[2])


@pytest.mark.parametrize(
    ("old", "new", "kept", "dropped"),
    [
        ("path", "manylights_direct", {"hide_emitters", "block_size"}, "max_depth, rr_depth"),
        ("path", "volpath", {"max_depth", "rr_depth", "hide_emitters", "block_size"}, None),
        ("path", "ptracer", {"hide_emitters"}, "max_depth, rr_depth, block_size"),
        (
            "volpathmis",
            "manylights_volpath",
            {"max_depth", "rr_depth", "hide_emitters", "block_size"},
            None,
        ),
    ],
)
def test_named_integrator_keeps_what_means_the_same(choose, old, new, kept, dropped):
    name, parameters, notes = choose(integrator(old, PATH_PARAMETERS), new)
    assert name == new
    assert set(parameters) == kept
    assert notes[0].partition("dropped ")[2] == (dropped or "")


def test_ours_replace_each_other_and_keep_the_tree(choose):
    tree = '<float name="splitting_rate" value="2"/><integer name="shadow_rays" value="3"/>'
    bsdf = '<integer name="bsdf_samples" value="2"/>'
    name, parameters, notes = choose(
        integrator("manylights_direct", tree + bsdf), "manylights_volpath"
    )
    assert name == "manylights_volpath"
    assert parameters == {"splitting_rate": 2.0, "shadow_rays": 3}
    assert "dropped bsdf_samples" in notes[0]


@pytest.mark.parametrize(
    ("plugin", "wrong", "listed"),
    [
        ("manylights_direct", "max_depth", "bsdf_samples (integer"),
        ("manylights_volpath", "bsdf_samples", "max_depth (integer"),
    ],
)
def test_unknown_parameters_are_refused_with_those_of_the_integrator(choose, plugin, wrong, listed):
    for text in (integrator(plugin), integrator("path")):
        with pytest.raises(UsageError) as raised:
            choose(text, plugin, **{wrong: 1})
        assert f'integrator["{wrong}"]: {plugin} has no such parameter' in str(raised.value)
        assert listed in str(raised.value) and f"{wrong} (" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("reservoirs", "many", "an integer from 1 to 64"),
        ("reservoirs", 2.0, "an integer from 1 to 64"),
        ("reservoirs", True, "an integer from 1 to 64"),
        ("reservoirs", None, "an integer from 1 to 64"),
        ("splitting_rate", "many", "a float >= 0 or inf"),
        ("counts", 1, "true or false"),
        ("counts", "true", "true or false"),
        ("learn_visibility", "no", "true, false or keep"),
        ("method", 3, "resampled_tree, talk, adaptive_splitting, tree or exhaustive"),
    ],
)
def test_parameters_of_wrong_types_are_named(choose, name, value, allowed):
    with pytest.raises(UsageError) as raised:
        choose(integrator("manylights_direct"), **{name: value})
    assert str(raised.value) == f'integrator["{name}"] {value!r}: must be {allowed}'


def test_parameters_of_right_types_are_taken(choose):
    right = {"reservoirs": np.int64(8), "splitting_rate": 2, "counts": True, "aovs": "Z:depth"}
    right |= {"learn_visibility": "keep", "method": "tree", "hide_emitters": np.bool_(True)}
    _, parameters, _ = choose(integrator("manylights_direct"), **right)
    assert parameters == right
    for rate in ("inf", float("inf"), np.float32(0.5), 0):
        _, parameters, _ = choose(integrator("manylights_direct"), splitting_rate=rate)
        assert parameters == {"splitting_rate": rate}


def test_channels_for_the_denoiser_are_added_to_those_of_the_scene(choose):
    """Those of another type under a wanted name stay."""
    wish = ours.Wish("albedo:albedo,normal:sh_normal")
    for own, all_of_them in (
        ("Z:depth", "Z:depth,albedo:albedo,normal:sh_normal"),
        ("Z:depth, normal:geo_normal", "Z:depth, normal:geo_normal,albedo:albedo"),
        (None, "albedo:albedo,normal:sh_normal"),
    ):
        text = f'<string name="aovs" value="{own}"/>' if own else ""
        _, parameters, _ = choose(integrator("manylights_direct", text), aovs=wish)
        assert parameters["aovs"] == all_of_them
        settings = {"aovs": own} if own else {}
        assert ours.joined(settings, {"aovs": wish}) == {"aovs": all_of_them}


@pytest.mark.parametrize("name", ["aovs", "light_groups"])
def test_a_parameter_that_an_argument_sets_too_is_refused(name, scene, capsys, tmp_path):
    require_variant("scalar_rgb")
    with pytest.raises(UsageError, match=rf'^{name}: integrator\["{name}"\] is the same, give one'):
        package.render(scene, integrator={"type": "manylights_direct", name: "x"}, **{name: "uv"})
    option = {"aovs": "--aov", "light_groups": "--light-groups"}[name]
    command = ["render", str(scene), "-o", str(tmp_path / "o.exr"), "--set", f"{name}=x"]
    assert cli.main([*command, option, "uv"]) == 2
    assert f"manylights: {option}: --set {name} is the same, give one" in capsys.readouterr().err


@pytest.mark.parametrize("plugin", ["path", "manylights_volpath"])
def test_paths_of_no_length_are_told(choose, plugin):
    words = "integrator: with max_depth=0 nothing is seen, its image is black"
    assert words in choose(integrator(plugin), "keep", max_depth=0)[2]
    assert words not in choose(integrator(plugin), "keep", max_depth=1)[2]
    text = '<integer name="max_depth" value="0"/>'
    assert words in choose(integrator(plugin, text))[2]


@pytest.mark.parametrize("plugin", ["manylights_direct", "manylights_volpath"])
def test_listed_parameters_are_those_of_the_plugin(plugin):
    """The plugin accepts all that the help lists, and the defaults are those it states."""
    mi.set_variant("scalar_rgb")
    for name, parameter in ours.PARAMETERS[plugin].items():
        default = ours.parse_value(str(parameter).rpartition("default ")[2].split(",")[0])
        default = "" if default == "none" else default
        assert default == parameter.default
        needed = {"method": "talk"} if name == "split_function" else {}
        untouched = mi.load_dict({"type": plugin, **needed})
        assert str(mi.load_dict({"type": plugin, name: default, **needed})) == str(untouched)


@pytest.mark.parametrize("plugin", ["manylights_direct", "manylights_volpath"])
def test_parameters_of_the_tree_are_found(tmp_path, plugin):
    mi.set_variant("scalar_rgb")
    path = tmp_path / "scene.xml"
    hidden = '<boolean name="hide_emitters" value="true"/>'
    parameters = f'<float name="splitting_rate" value="2"/>{hidden}'
    path.write_text(f'<scene version="3.0.0">{integrator(plugin, parameters)}</scene>')
    state = loading.parse(str(path)).state
    assert integrators.ours_in(state) == (plugin, {"splitting_rate": 2.0})


def test_help_lists_the_parameters_of_both_plugins():
    text = manylights("render", "--help").stdout
    for plugin, parameters in ours.PARAMETERS.items():
        table = text.partition(f"parameters of {plugin}:")[2]
        assert all(f"  {name} " in table for name in parameters)


@pytest.mark.parametrize("old", ["path", "volpath", None])
def test_paths_are_rendered_with_the_tree(tmp_path, old):
    """The command renders a scene of a path tracer, or without integrator, with the plugin."""
    start, end = DIRECT.index("<integrator"), DIRECT.index("<sensor")
    text = integrator(old, '<integer name="max_depth" value="3"/>') if old else ""
    path = tmp_path / "scene.xml"
    path.write_text(DIRECT[:start] + text + DIRECT[end:])
    log = render(path, tmp_path / "out.exr", "--set", "shadow_rays=2").stderr
    assert "manylights_volpath" in log
    assert np.array(mi.Bitmap(str(tmp_path / "out.exr"))).mean() > 0


def test_scene_parameters_are_set(scene, tmp_path):
    means = []
    for value in (1, 2):
        out = tmp_path / f"{value}.exr"
        render(scene, out, "-D", f"brightness={value}")
        means.append(np.array(mi.Bitmap(str(out)))[..., :3].mean())
    assert means[1] == pytest.approx(2 * means[0], rel=1e-4)


def test_tree_as_json():
    result = manylights("tree", SCENES / "many_bulbs.xml", "--json")
    assert result.returncode == 0, result.stderr
    tree = json.loads(result.stdout)
    assert set(tree) == {
        "lights",
        "lights_in_tree",
        "nodes",
        "depth",
        "bytes",
        "build_ms",
        "kinds",
    }
    assert tree["lights"] == tree["lights_in_tree"] == 480
    assert tree["kinds"] == {"area triangle": 480}


def test_tree_leaves_the_environment_out():
    tree = json.loads(manylights("tree", SCENES / "constant.xml", "--json").stdout)
    assert (tree["lights"], tree["lights_in_tree"]) == (3, 2)


def test_tree_of_an_integrator_for_paths():
    result = manylights("tree", SCENES / "interior.xml", "--json")
    assert result.returncode == 0, result.stderr
    tree = json.loads(result.stdout)
    assert tree["lights"] == tree["lights_in_tree"] > 0


def test_tree_as_text():
    result = manylights_process("tree", SCENES / "points.xml")
    assert result.returncode == 0, result.stderr
    assert "12  point" in result.stdout


def test_demo(tmp_path):
    arguments = ("--lights", 200, "--spp", 1, "--width", 32, "--height", 18)
    result = manylights("demo", "-o", tmp_path / "city", "--variant", "scalar_rgb", *arguments)
    assert result.returncode == 0, result.stderr
    assert "200 lights" in result.stdout
    assert (tmp_path / "city.exr").exists() and (tmp_path / "city.png").exists()


def test_missing_scene(tmp_path):
    process = manylights_process("render", tmp_path / "no.xml", "-o", tmp_path / "o.exr")
    assert_fails(process, "no.xml", "no such file")


def test_broken_scene(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text('<scene version="3.0.0"><shape')
    assert_fails(manylights("tree", path), "broken.xml")


def test_unknown_parameter(scene, tmp_path):
    process = manylights("render", scene, "-o", tmp_path / "o.exr", "--set", "splits=1")
    assert_fails(process, "splits", "splitting_rate")


def test_parameter_out_of_range(scene, tmp_path):
    process = manylights("render", scene, "-o", tmp_path / "o.exr", "--set", "splitting_rate=-1")
    assert_fails(process, "splitting_rate", "-1")


SPHERE = {"type": "scene", "sensor": {"type": "perspective"}, "ball": {"type": "sphere"}}
DEPTH = {**SPHERE, "integrator": {"type": "depth"}}


@pytest.mark.parametrize(
    ("python", "said", "shell", "typed"),
    [
        ({"output": "o.png"}, "output o.png: the image is", "-o o.png", "-o o.png: the image is"),
        (
            {"learnt": "a.exr"},
            "learnt 'a.exr': must be given with part",
            "--learnt a.exr",
            "--learnt a.exr: must be given with --part",
        ),
        (
            {"part": (1, 2), "exposure": 1.0},
            "exposure 1.0: must be left out with part, and given to manylights.merge",
            "--part 1/2 --exposure 1",
            "--exposure 1.0: must be left out with --part, and given to manylights merge",
        ),
        (
            {"integrator": {"type": "manylights_direct", "reservoir": 2}},
            'integrator["reservoir"]: manylights_direct has no such',
            "--set reservoir=2",
            "--set reservoir: manylights_direct has no such",
        ),
        ({"aovs": "color"}, "aovs 'color': must be", "--aov color", "--aov 'color': must be"),
        (
            {"scene": DEPTH, "aovs": "uv"},
            "aovs: depth shows no surfaces, manylights_direct or manylights_volpath do (int",
            "--integrator depth --aov uv",
            "--aov: depth shows no surfaces, manylights_direct or manylights_volpath do (--int",
        ),
        (
            {"scene": DEPTH, "light_groups": "a=b"},
            "light_groups: depth has none, ",
            "--integrator depth --light-groups a=b",
            "--light-groups: depth has none, ",
        ),
        ({"tev": "a:b"}, "tev a:b: must be HOST:PORT", "--tev a:b", "--tev a:b: must be HOST:PORT"),
    ],
)
def test_messages_name_what_was_typed_in_python_or_in_the_shell(
    scene, tmp_path, monkeypatch, capsys, python, said, shell, typed
):
    monkeypatch.chdir(tmp_path)
    require_variant("scalar_rgb")
    with pytest.raises(UsageError) as raised:
        package.render(**{"scene": SPHERE, "spp": 1, **python})
    assert str(raised.value).startswith(said)
    command = ["render", str(scene), "--spp", "1", "--variant", "scalar_rgb", *shlex.split(shell)]
    assert cli.main(command + ([] if "-o" in command else ["-o", "o.exr"])) == 2
    assert f"manylights: {typed}" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.exr"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--workers local:2 --for 10m", "workers: need a number of samples or a noise"),
        ("--part 1/2 --for 10m", "part 1 of 2: needs a fixed number of samples"),
        ("--part 1/2 --until-noise 0.1", "part 1 of 2: needs a fixed number of samples"),
        ("--part 1/2 --exposure 1", "--exposure 1.0: must be left out with --part"),
        ("--part 1/2 --learnt no.exr", "--learnt no.exr: no such file"),
        ("--learnt scene.xml", "--learnt scene.xml: must be given with --part"),
        ("--ship", "--ship: must be given with --workers"),
        ("--integrator path --aov uv", "--aov: path shows no surfaces"),
        ("--integrator path --light-groups a=b", "--light-groups: path has none"),
        ("--integrator manylights_direct --set max_depth=3", "--set max_depth: manylights_direct"),
        ("--set hide_emitters=false --hide-lights", "--hide-lights: --set hide_emitters is the"),
        ("--tev a:b", "--tev a:b: must be HOST:PORT"),
        ("--workers local:2 --time 3", "--time: scene.xml is XML"),
        ("--workers local:2 SCENE=no.xml", "no.xml: no such file"),
        ("--workers local:2 SCENE=stage.usda -D a=1", "-D a: stage.usda is USD"),
    ],
)
def test_what_the_command_line_rules_out_is_refused_before_anything_is_begun(
    scene, tmp_path, monkeypatch, capsys, arguments, words
):
    from manylights.rendering import workers

    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_bytes(scene.read_bytes())
    (tmp_path / "stage.usda").write_text("#usda 1.0\n")
    for module, name in ((package.loading, "load"), (workers, "Connection")):
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("begun"))
    given = arguments.split()
    name = next((word[6:] for word in given if word.startswith("SCENE=")), "scene.xml")
    given = [word for word in given if not word.startswith("SCENE=")]
    command = ["render", name, "-o", "o.exr", "--variant", "scalar_rgb", *given]
    assert cli.main(command) == 2
    assert f"manylights: {words}" in capsys.readouterr().err


def test_what_arguments_rule_out_is_refused_before_the_scene_is_loaded(scene, monkeypatch):
    require_variant("scalar_rgb")
    monkeypatch.setattr(package.loading, "as_loaded", lambda *_: pytest.fail("begun"))
    for wrong in (
        {"part": (1, 2), "seconds": 1.0},
        {"part": (3, 2)},
        {"client": object(), "seconds": 1.0},
        {"ship": True},
        {"learnt": "a.exr"},
        {"part": (1, 2), "learnt": "no.exr"},
        {"tev": "a:b"},
    ):
        with pytest.raises(UsageError):
            package.render(scene, spp=1, **wrong)


def test_notes_say_how_to_undo_a_choice_in_python_or_in_the_shell(scene, tmp_path, capsys):
    require_variant("scalar_rgb")
    notes = package.render(scene, spp=1).notes
    assert any(note.endswith('(integrator="keep" undoes it)') for note in notes)
    assert any(note.endswith("(an mi.Scene keeps its own)") for note in notes)
    command = ["render", str(scene), "-o", str(tmp_path / "o.exr"), "--spp", "1"]
    assert cli.main([*command, "--variant", "scalar_rgb"]) == 0
    said = capsys.readouterr().err
    assert "(--integrator keep undoes it)" in said and "(--sampler keep undoes it)" in said


def test_convert_names_its_output_as_it_was_typed(capsys):
    assert cli.main(["convert", "stage.usda", "out.txt"]) == 2
    assert capsys.readouterr().err.startswith("manylights: out.txt: Mitsuba's scenes are XML files")


def test_unknown_scene_parameter(scene, tmp_path):
    process = manylights("render", scene, "-o", tmp_path / "o.exr", "-D", "sky=1")
    assert_fails(process, f"manylights: -D sky: {scene} has no <default> of this name")


def test_unknown_variant(scene, tmp_path):
    process = manylights("render", scene, "-o", tmp_path / "o.exr", "--variant", "fast")
    assert_fails(process, "fast", "scalar_rgb")


def test_unknown_sensor(scene, tmp_path):
    process = manylights("render", scene, "-o", tmp_path / "o.exr", "--sensor", "4")
    assert_fails(process, "--sensor 4")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing/out.exr", "there is no folder"),
        ("scene.xml/out.exr", "there is no folder"),
        ("taken.exr", "it is a folder"),
        ("out.png", "end the name in .exr"),
    ],
)
def test_output_that_cannot_be_written_is_refused_before_the_render(scene, tmp_path, name, reason):
    (tmp_path / "taken.exr").mkdir()
    before = sorted(tmp_path.rglob("*"))
    process = manylights("render", scene, "-o", tmp_path / name)
    assert_fails(process, name, reason)
    assert len(process.stderr.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_folder_that_takes_no_files_is_refused_before_the_render(scene):
    """Also where permissions bind nobody, as they do not bind root."""
    if not Path("/proc").is_dir():
        pytest.skip("no /proc")
    process = manylights("render", scene, "-o", "/proc/out.exr")
    assert_fails(process, "-o /proc/out.exr: not writable (")
    assert len(process.stderr.splitlines()) == 1


@pytest.mark.parametrize("missing", [1, 100, 1000])
def test_full_disk_leaves_nothing_half_written(scene, tmp_path, missing):
    """The limit of a file's size stands for the disk.

    With 33 lines the last one is a chunk of its own. Mitsuba's file stream buffers that, and does
    not tell if there is no room for it in the end.
    """
    scene.write_text(
        scene.read_text().replace('name="height" value="16"', 'name="height" value="33"')
    )
    render(scene, tmp_path / "out.exr")
    size = (tmp_path / "out.exr").stat().st_size - missing
    for name in ("out.exr", "out.png"):
        (tmp_path / name).write_bytes(b"of an earlier render")
    command = ("render", scene, "-o", tmp_path / "out.exr", "--variant", "scalar_rgb", "--spp", 4)
    limit = (resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    process = manylights_process(*command, preexec_fn=lambda: resource.setrlimit(*limit))
    assert_fails(process, f"{tmp_path / 'out.exr'}: not written (File too large)")
    assert {path.name for path in tmp_path.iterdir()} == {"scene.xml", "out.exr", "out.png"}
    for name in ("out.exr", "out.png"):
        assert (tmp_path / name).read_bytes() == b"of an earlier render"


#: Files that a scene refers to, and the scene's element.
REFERENCES = {
    "bulbs.ply": '<shape type="ply"><string name="filename" value="{}"/></shape>',
    "octahedron.obj": '<shape type="obj"><string name="filename" value="{}"/></shape>',
    "dusk.exr": '<emitter type="envmap"><string name="filename" value="{}"/></emitter>',
    "slide.png": '<texture type="bitmap"><string name="filename" value="{}"/></texture>',
    "torus.vol": '<volume type="gridvolume"><string name="filename" value="{}"/></volume>',
    "other.xml": '<include filename="{}"/>',
}


def referring(folder, name):
    """A scene in `folder` that refers to the file of this name beside it."""
    path = folder / "scene.xml"
    element = REFERENCES[name].format(name)
    path.write_text(DIRECT.replace("</scene>", f"{element}</scene>"))
    return path


def fail_to_render(capsys, scene):
    """Render in this process; return the last line after checking that it says what failed."""
    out = scene.with_name("out.exr")
    command = ["render", str(scene), "-o", str(out), "--variant", "scalar_rgb"]
    assert cli.main(command) == 2
    assert not out.exists()
    return capsys.readouterr().err.splitlines()[-1]


def linked(tmp_path, beside):
    """A link to a scene file among blobs, as caches keep them, and a file in one of the folders."""
    blobs, snapshot = tmp_path / "blobs", tmp_path / "snapshot"
    blobs.mkdir()
    snapshot.mkdir()
    referring(blobs, "bulbs.ply").rename(blobs / "1b9a")
    (blobs / "7c30").write_bytes((SCENES / "data" / "bulbs.ply").read_bytes())
    path = snapshot / "scene.xml"
    path.symlink_to("../blobs/1b9a")
    (tmp_path / beside / "bulbs.ply").symlink_to(blobs / "7c30")
    return path


@pytest.mark.parametrize("beside", ["snapshot", "blobs"])
@pytest.mark.parametrize("relative", [False, True])
def test_files_are_found_beside_a_link(scalar, tmp_path, monkeypatch, beside, relative):
    """Beside the path that was given, else beside the file that it leads to."""
    path = linked(tmp_path, beside)
    if relative:
        monkeypatch.chdir(path.parent)
    files = loading.load(path.name if relative else str(path)).files
    assert [file.name for file in files] == ["scene.xml", "bulbs.ply"]
    assert files[1].parent == tmp_path / beside


def test_files_beside_a_link_come_before_those_beside_the_scene(scalar, tmp_path):
    path = linked(tmp_path, "snapshot")
    (tmp_path / "blobs" / "bulbs.ply").write_text("not the one")
    assert loading.load(str(path)).files[1].parent == path.parent


@pytest.mark.parametrize("name", REFERENCES)
def test_missing_file_of_a_scene_is_named(capsys, tmp_path, name):
    line = fail_to_render(capsys, referring(tmp_path, name))
    assert line.startswith("manylights: ") and name in line and "scene.xml" in line


@pytest.mark.parametrize("part", [0.0, 0.01, 0.3, 0.7])
@pytest.mark.parametrize("name", ["bulbs.ply", "slide.png", "torus.vol"])
def test_truncated_file_of_a_scene_is_named(capsys, tmp_path, name, part):
    data = (SCENES / "data" / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(part * len(data))])
    line = fail_to_render(capsys, referring(tmp_path, name))
    assert line.startswith("manylights: ") and name in line


@pytest.mark.parametrize("part", [0.0, 0.01, 0.7])
def test_truncated_openexr_file_does_not_end_the_process(tmp_path, part):
    """Several files: which threads read them is left to chance."""
    data = (SCENES / "data" / "glow.exr").read_bytes()
    shapes = ""
    for index in range(8):
        (tmp_path / f"{index}.exr").write_bytes(data[: int(part * len(data))])
        shapes += f"""<shape type="sphere"><bsdf type="diffuse">
            <texture type="bitmap" name="reflectance">
                <string name="filename" value="{index}.exr"/>
            </texture></bsdf></shape>"""
    path = tmp_path / "scene.xml"
    path.write_text(DIRECT.replace("</scene>", f"{shapes}</scene>"))
    for command in (("render", path, "-o", tmp_path / "out.exr"), ("tree", path)):
        process = manylights_process(*command, "--variant", "scalar_rgb")
        assert_fails(process, ".exr: not a whole image")


@pytest.mark.parametrize("text", ["", DIRECT[:200], DIRECT[:-10], "\0\1\2", "<scene", "a scene"])
def test_scene_file_that_is_no_xml_is_named(capsys, tmp_path, text):
    path = tmp_path / "broken.xml"
    path.write_text(text)
    assert str(path) in fail_to_render(capsys, path)


def test_debug_shows_the_traceback(tmp_path):
    process = manylights_process("tree", tmp_path / "no.xml", "--debug")
    assert process.returncode != 0
    assert "Traceback" in process.stderr


def test_version():
    assert manylights_process("--version").stdout.strip() == __version__
    lines = manylights("--verbose", "--version").stdout.splitlines()
    told = dict(line.split(":", 1) for line in lines)
    assert mi.__version__ in told["Mitsuba"] and told["plugins"].strip() == plugin_dir()
    variants = told["variants"].strip().split(", ")
    assert "scalar_rgb" in variants and set(variants) <= set(mi.variants())


COMPLETE = """
source completion
COMP_WORDS=(manylights $@) COMP_CWORD=$#
_shtab_manylights
echo "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def completion():
    return manylights_process("--print-completion", "bash").stdout


@pytest.mark.parametrize(
    ("typed", "offered"),
    [("re", "render report"), ("render --until", "--until-noise"), ("render sc", "scene.xml")],
)
def test_bash_completes_commands_options_and_files(completion, tmp_path, typed, offered):
    if shutil.which("bash") is None:
        pytest.skip("there is no bash")
    (tmp_path / "completion").write_text(completion)
    (tmp_path / "scene.xml").touch()
    done = subprocess.run(
        ["bash", "-c", COMPLETE, "bash", *typed.split()],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stderr, done.stdout.strip()) == ("", offered)


@pytest.mark.parametrize("command", [(), ("render",)])
def test_help_begins_with_examples_that_are_understood(command):
    text = manylights(*command, "--help").stdout
    examples = text.partition("\nexamples:\n")[2].partition("\n\n")[0].splitlines()
    assert len(examples) == 3
    for line in examples:
        # What it does is said after some spaces.
        parser().parse_args(shlex.split(re.split(r"\s{3,}", line.strip())[0])[1:])


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "manylights: which COMMAND? (see manylights --help)"),
        ("rendr", "manylights: COMMAND invalid choice: 'rendr'"),
        ("render", "manylights render: the following arguments are required: SCENE, -o/--output ("),
        ("render --spp 0", "manylights render: --spp 0: must be an integer of at least 1 ("),
        ("render --spp many", "manylights render: --spp many: must be an integer of at least 1 ("),
        ("render --threads 5000", "render: --threads 5000: must be an integer from 1 to 4096 ("),
        ("render --sensor -1", "render: --sensor -1: must be an integer of at least 0 ("),
        ("render --seed 1.5", "render: --seed 1.5: must be an integer from 0 to 4294967295 ("),
        ("render --seed 4294967296", "render: --seed 4294967296: must be an integer from 0 to"),
        ("render --exposure high", "render: --exposure high: must be a number from -64 to 64 ("),
        ("render s.xml -o o.exr --fast", "render: unknown: --fast (see manylights render --help)"),
        ("tree a.xml b.xml", "manylights tree: unknown: b.xml (see manylights tree --help)"),
        ("demo --lights 0", "demo: --lights 0: must be an integer from 1 to 1,000,000 ("),
        ("demo --lights 1000001", "--lights 1000001: must be an integer from 1 to 1,000,000 ("),
        ("bench --seeds few", "manylights bench: --seeds few: must be at least 1, the number of"),
    ],
)
def test_a_wrong_command_line_gets_one_line(capsys, command, message):
    with pytest.raises(SystemExit) as raised:
        cli.main(command.split())
    assert raised.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and line.endswith("--help)")


def test_demo_does_not_add_an_ending_twice(tmp_path, capsys):
    small = ["--lights", "1", "--spp", "1", "--width", "4", "--height", "4"]
    out = str(tmp_path / "city.exr")
    assert cli.main(["demo", "-o", out, *small, "--variant", "scalar_rgb"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["city.exr", "city.png"]


def test_estimate_advances_between_reports_but_not_past_the_next_one():
    now = [0.0]
    estimate = Estimate(clock=lambda: now[0])
    assert estimate.fraction() == 0.0 and estimate.seconds_left() is None
    now[0] = 10.0
    estimate.report(0.25)
    assert estimate.seconds_left() == pytest.approx(30.0)
    now[0] = 15.0
    assert estimate.fraction() == pytest.approx(0.375)
    now[0] = 100.0
    assert estimate.fraction() == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("seconds", "text"), [(None, "-:--"), (0.4, "0:00"), (65, "1:05"), (3723, "1:02:03")]
)
def test_times_are_readable(seconds, text):
    assert format_seconds(seconds) == text


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_ctrl_c_leaves_no_file(tmp_path, variant):
    variant = require_variant(variant)
    out = tmp_path / "out.exr"
    command = [sys.executable, "-m", "manylights", "render", SCENES / "points.xml", "-o", out]
    command += ["--spp", "200000", "--variant", variant]
    process = subprocess.Popen(
        list(map(str, command)),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
    )
    try:
        # The last line before the render starts names the integrator.
        while not process.stderr.readline().startswith("integrator:"):
            assert process.poll() is None
        time.sleep(1.0)
        start = time.monotonic()
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(timeout=60) == 130
        assert time.monotonic() - start < 20
    finally:
        process.kill()
        process.stderr.close()
    assert list(tmp_path.iterdir()) == []

"""The command `manylights bench`: what it measures, what it writes, how it goes on."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights.bench import (
    calibration,
    drawing,
    methods,
    records,
    runner,
    samplers,
    scene_source,
    standard,
)
from manylights.bench.drawing import Drawing
from manylights.bench.folder import open_folder
from manylights.bench.methods import Kind, Method
from manylights.bench.moments import Moments
from manylights.bench.workload import Workload
from manylights.cli import main
from manylights.errors import UsageError

from tests.conftest import heed_ctrl_c, require_variant

pytest.importorskip("flip_evaluator")

SCENES = Path(__file__).parent.parent / "scenes"
TINY = "width=32,height=18"
CITY = f"city:40,kind=points,{TINY}"
CITY_NAME = "city-40-kind-points-width-32-height-18"

#: A quick measurement: two methods, two seeds.
FEW = (
    "--methods",
    "power,resampled_tree",
    "--spp",
    "1,2",
    "--seeds",
    "2",
    "--variant",
    "scalar_rgb",
)

SERIES_KEYS = {
    *("spec", "method", "parameters", "integrator", "sampler", "build_seconds", "first_seconds"),
    *("equal_time", "points"),
}
POINT_KEYS = {"spp", "seed", "seconds", "cpu_seconds", "error", "error_trimmed", "flip", "mean"}
SCENE_KEYS = {
    *("name", "title", "family", "lights", "source", "hash", "width", "height", "max_depth"),
    *("media", "private", "boundary", "equal_time", "reference", "series", "skipped"),
}


@pytest.fixture
def scalar_variant(scalar):
    return scalar


def bench(out, *arguments):
    """Run the command in this process; return its status and the results."""
    status = main(["bench", "--out", str(out), "--time-budget", "0.02", *map(str, arguments)])
    path = Path(out) / "results.json"
    return status, json.loads(path.read_text()) if path.exists() else None


def series_by_spec(scene):
    return {series["spec"]: series for series in scene["series"]}


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Folder and results of a quick measurement, not to be changed."""
    out = tmp_path_factory.mktemp("bench") / "out"
    status, data = bench(out, CITY, *FEW)
    assert status == 0
    return out, data


@pytest.fixture
def copy(measured, tmp_path):
    """A copy of that folder."""
    return Path(shutil.copytree(measured[0], tmp_path / "copy"))


def test_results_have_the_promised_keys(measured):
    _, data = measured
    assert data["format"] == 1 and data["variant"] == "scalar_rgb"
    assert set(data["versions"]) == {"manylights", "mitsuba", "drjit", "python", "numpy"}
    assert set(data["machine"]) == {"processor", "cores", "threads", "memory_gib", "system"}
    assert data["metric"] == {"epsilon": 0.05, "trim": 0.001}
    (scene,) = data["scenes"]
    assert set(scene) >= SCENE_KEYS
    assert (scene["lights"], scene["width"], scene["height"], scene["max_depth"]) == (40, 32, 18, 2)
    for series in scene["series"]:
        assert set(series) == SERIES_KEYS
        assert (series["sampler"] == "manylights_sobol") == (series["method"] in methods.OURS)
        assert [point["spp"] for point in series["points"]] == [1, 2]
        for point in series["points"]:
            assert set(point) == POINT_KEYS
            assert point["seed"] == [1, 2]
            for key in POINT_KEYS - {"spp"}:
                assert len(point[key]) == 2 and np.isfinite(point[key]).all()
            assert min(point["seconds"]) > 0 and min(point["cpu_seconds"]) > 0
        assert set(series["equal_time"]) == {"spp", "seconds", "error", "error_trimmed", "flip"}


def test_series_say_what_was_rendered(measured):
    series = series_by_spec(measured[1]["scenes"][0])
    assert list(series) == ["power", "resampled_tree"]
    assert series["power"]["integrator"] == {"type": "direct"}
    assert series["power"]["build_seconds"] == 0
    ours = series["resampled_tree"]
    assert ours["integrator"] == {"type": "manylights_direct", "method": "resampled_tree"}
    assert 0 < ours["build_seconds"] < ours["first_seconds"]


def test_images_are_those_of_the_results(measured):
    out, data = measured
    folder, scene = out / CITY_NAME, data["scenes"][0]
    names = {path.name for path in folder.glob("*.exr")}
    assert names == {
        "reference.exr",
        *(f"{key}{end}.exr" for key in ("power", "resampled_tree") for end in ("", ".variance")),
        "resampled_tree.maps.exr",
    }
    reference = np.array(mi.Bitmap(str(folder / "reference.exr")))
    assert reference.shape == (18, 32, 3)
    assert reference.mean() == pytest.approx(scene["reference"]["mean"], rel=1e-5)
    maps = mi.Bitmap(str(folder / "resampled_tree.maps.exr"))
    assert [field.name for field in maps.struct_()] == ["candidates", "node_visits"]
    assert np.array(maps)[..., 0].max() > 1


def test_reference_has_64_times_the_samples_and_its_own_error(measured):
    reference = measured[1]["scenes"][0]["reference"]
    assert reference["integrator"] == "manylights_direct"
    assert reference["spp"] == 64 * 2
    assert 0 < reference["error"] < 1
    assert 0 < reference["mean_error"] < 0.2 * reference["mean"]


def test_errors_and_variances_are_those_of_the_renders(measured):
    """What the files say is what rendering the same again gives."""
    out, data = measured
    mi.set_variant("scalar_rgb")
    loaded = scene_source.find(CITY).load()
    integrator = mi.load_dict({"type": "manylights_direct"})
    sensor = loaded.sensors[samplers.OURS]
    images = [
        np.array(mi.render(loaded.scene, sensor=sensor, integrator=integrator, spp=2, seed=seed))
        for seed in (1, 2)
    ]
    (series,) = [s for s in data["scenes"][0]["series"] if s["method"] == "resampled_tree"]
    point = series["points"][1]
    np.testing.assert_allclose(point["mean"], [image.mean() for image in images], rtol=1e-4)
    variance = np.array(mi.Bitmap(str(out / CITY_NAME / "resampled_tree.variance.exr")))
    expected = 2 * np.var(images, axis=0, ddof=1)
    np.testing.assert_allclose(variance, expected, rtol=1e-3, atol=1e-6 * expected.max())


def test_nothing_is_rendered_twice(copy, capsys):
    before = (copy / "results.json").read_text()
    status, _ = bench(copy, CITY, *FEW)
    assert status == 0
    assert "nothing to do" in capsys.readouterr().err
    assert (copy / "results.json").read_text() == before


def test_more_seeds_and_methods_are_added(copy):
    before = json.loads((copy / "results.json").read_text())["scenes"][0]
    arguments = (
        "--methods",
        "talk:splitting_rate=2,power",
        "--seeds",
        3,
        "--variant",
        "scalar_rgb",
    )
    _, data = bench(copy, CITY, *arguments, "--spp", "1,2")
    (scene,) = data["scenes"]
    old, new = series_by_spec(before), series_by_spec(scene)
    assert set(new) == {"power", "resampled_tree", "talk:splitting_rate=2"}
    assert new["resampled_tree"] == old["resampled_tree"]
    assert scene["reference"] == before["reference"]
    for point, earlier in zip(new["power"]["points"], old["power"]["points"]):
        assert point["seed"] == [1, 2, 3]
        assert point["seconds"][:2] == earlier["seconds"]
        assert point["error"][:2] == earlier["error"]
    assert new["talk:splitting_rate=2"]["parameters"] == {"splitting_rate": 2.0}
    assert (copy / CITY_NAME / "talk-splitting_rate-2.exr").exists()


def test_the_variance_is_that_of_all_seeds_after_going_on(copy):
    bench(copy, CITY, *FEW, "--seeds", 4)
    moments = Moments.load(next((copy / CITY_NAME).glob("power.moments*")))
    assert moments.seeds == [1, 2, 3, 4]


def test_a_scene_that_changed_is_measured_anew(tmp_path):
    path = tmp_path / "points.xml"
    text = (SCENES / "points.xml").read_text()
    hashes = []
    for content in (text, text.replace("</scene>", "<!-- changed --></scene>")):
        path.write_text(content)
        defines = ("-D", "resx=16", "-D", "resy=9")
        status, data = bench(tmp_path / "out", path, *FEW, *defines)
        assert status == 0
        (scene,) = data["scenes"]
        hashes.append(scene["hash"])
        assert all(point["seed"] == [1, 2] for s in scene["series"] for point in s["points"])
    assert hashes[0] != hashes[1]


def test_ladder_grows_by_four_within_the_budget(tmp_path):
    """Without --spp samples are 1, 4, 16, ... and resuming keeps them."""
    source = "open_plane:2,width=8,height=6"
    arguments = (source, "--methods", "uniform", "--variant", "scalar_rgb")
    arguments = (*arguments, "--time-budget", "0.004", "--seeds")
    _, first = bench(tmp_path, *arguments, 1)
    spps = [point["spp"] for point in first["scenes"][0]["series"][0]["points"]]
    assert spps == [4**i for i in range(len(spps))]
    _, second = bench(tmp_path, *arguments, 2)
    points = second["scenes"][0]["series"][0]["points"]
    assert [point["spp"] for point in points] == spps
    assert all(point["seed"] == [1, 2] for point in points)


def test_power_equal_to_uniform_is_left_out(tmp_path):
    source = f"open_plane:1,{TINY}"
    _, data = bench(tmp_path, source, *FEW)
    (skipped,) = data["scenes"][0]["skipped"]
    assert skipped["spec"] == "power" and "the same as uniform" in skipped["why"]


def test_exhaustive_is_left_out_with_many_lights(tmp_path):
    arguments = ("--methods", "exhaustive,resampled_tree", *FEW[2:], "--spp", 1)
    _, data = bench(tmp_path, f"city:10001,{TINY}", *arguments)
    scene = data["scenes"][0]
    assert [series["spec"] for series in scene["series"]] == ["resampled_tree"]
    assert scene["skipped"] == [{"spec": "exhaustive", "why": "10,001 lights: more than 10,000"}]


def test_every_method_measures_the_same_image(tmp_path):
    """By default all methods are measured, and their means agree roughly."""
    source = f"open_plane:5,{TINY}"
    _, data = bench(tmp_path, source, "--variant", "scalar_rgb", "--seeds", 1, "--spp", "16")
    scene = data["scenes"][0]
    series = series_by_spec(scene)
    assert set(series) == set(methods.NAMES)
    for found in series.values():
        assert found["points"][0]["mean"][0] == pytest.approx(scene["reference"]["mean"], rel=0.2)


def test_fog_is_rendered_by_integrators_for_media(tmp_path):
    source = f"fog_open:40,max_depth=3,{TINY}"
    arguments = ("--methods", "uniform,talk", "--spp", 1, "--seeds", 1, "--variant", "scalar_rgb")
    # Methods that take 20 times as long are left out, as they are on a busy machine.
    _, data = bench(tmp_path, source, *arguments, "--time-budget", "0.2")
    scene = data["scenes"][0]
    assert scene["media"] and scene["max_depth"] == 3
    series = series_by_spec(scene)
    assert series["uniform"]["integrator"] == {"type": "volpath", "max_depth": 3}
    assert series["talk"]["integrator"]["type"] == "manylights_volpath"


def test_a_given_reference_is_used(measured, tmp_path):
    path = measured[0] / CITY_NAME / "reference.exr"
    status, data = bench(tmp_path, CITY, *FEW, "--reference", path)
    assert status == 0
    reference = data["scenes"][0]["reference"]
    assert (reference["integrator"], reference["spp"]) == ("reference.exr", 0)
    assert reference["error"] == reference["mean_error"] == 0
    assert reference["mean"] == pytest.approx(
        measured[1]["scenes"][0]["reference"]["mean"], rel=1e-5
    )
    old = measured[1]["scenes"][0]["series"][0]["points"][0]
    new = data["scenes"][0]["series"][0]["points"][0]
    np.testing.assert_allclose(new["error"], old["error"], rtol=1e-4)
    assert data["scenes"][0]["hash"] != measured[1]["scenes"][0]["hash"]


def test_private_scenes_are_marked(tmp_path):
    arguments = ("--methods", "uniform", "--spp", 1, "--seeds", 1, "--variant", "scalar_rgb")
    _, data = bench(tmp_path, f"open_plane:2,{TINY}", "--also", f"open_plane:3,{TINY}", *arguments)
    assert [scene["private"] for scene in data["scenes"]] == [False, True]


def test_no_tree_is_built_on_the_clock_after_power_sampling(tmp_path, llvm, monkeypatch):
    """With an environment each change of the weights makes the emitters look new to the tree."""
    built = []

    def watched(loaded, integrator, spp, seed, sampler):
        ours = "build_ms" in mi.traverse(integrator)
        before = build_time(integrator) if ours else 0.0
        result = drawing.draw(loaded, integrator, spp, seed, sampler)
        if ours and seed <= 2:
            built.append(build_time(integrator) != before)
        return result

    def build_time(integrator):
        return np.ravel(mi.traverse(integrator)["build_ms"])[0]

    monkeypatch.setattr(runner, "draw", watched)
    size = ("-D", "resx=16", "-D", "resy=9")
    status, data = bench(tmp_path, SCENES / "constant.xml", *FEW, "--variant", llvm, *size)
    assert status == 0
    assert set(series_by_spec(data["scenes"][0])) == {"power", "resampled_tree"}
    assert built == [False] * 4


def assert_fails(capsys, arguments, *words):
    """The command returns 2 and its last line on stderr has all the words."""
    capsys.readouterr()
    try:
        status = main(["bench", *map(str, arguments)])
    except SystemExit as error:
        status = error.code
    assert status == 2
    lines = capsys.readouterr().err.strip().splitlines()
    for word in words:
        assert word in lines[-1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ("SCENE", "--standard")),
        (("no.xml",), ("no.xml", "no such file")),
        (("village:10",), ("village:10", "city")),
        (("city:many",), ("city:many", "not a number of lights")),
        (("city:0",), ("city:0", "from 1 to")),
        (("city:10,kind=lasers",), ("lasers", "points")),
        (("city:10,colour=red",), ("city:10,colour=red", "colour")),
        (("city:10,integrator=depth",), ("city:10,integrator=depth", "volpath")),
        ((CITY, "-D", "width=9"), ("-D width: no SCENE is an XML file",)),
        ((CITY, "--camera", "/eye"), ("--camera: no SCENE is a USD stage",)),
        ((CITY, "--methods", "best"), ("--methods best", "uniform", "exhaustive")),
        ((CITY, "--methods", "talk:speed=2"), ("--methods talk:speed=2", "splitting_rate")),
        ((CITY, "--methods", "talk:splitting_rate=-2"), ("--methods talk", "splitting_rate", "-2")),
        ((CITY, "--methods", "power:reservoirs=2"), ("power:reservoirs=2", "no parameters")),
        ((CITY, "--spp", "0"), ("--spp", "at least 1")),
        ((CITY, "--spp", "1,x"), ("--spp", "integers")),
        ((CITY, "--seeds", "0"), ("--seeds", "at least 1")),
        ((CITY, "--time-budget", "0"), ("--time-budget", "above 0")),
        ((CITY, "--variant", "fast"), ("--variant fast", "scalar_rgb")),
        ((CITY, "--reference", "no.exr"), ("--reference no.exr", "no such file")),
        ((CITY, "city:10", "--reference", "no.exr"), ("--reference", "one SCENE")),
    ],
)
def test_bad_input_is_named(capsys, tmp_path, arguments, words):
    out = () if "--variant" in arguments else ("--variant", "scalar_rgb")
    assert_fails(capsys, (*arguments, "--out", tmp_path / "out", *out), *words)


def test_a_reference_in_the_folder_of_results_stays(capsys, copy):
    path = next(copy.glob("*/reference.exr"))
    before = path.read_bytes()
    words = (CITY, *FEW, "--out", copy, "--reference", path)
    assert_fails(capsys, words, f"--reference {path}: is in the folder --out {copy}")
    assert path.read_bytes() == before


def test_broken_scene(capsys, tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text('<scene version="3.0.0"><shape')
    assert_fails(capsys, (path, "--out", tmp_path / "out"), "broken.xml")


def test_unwritable_folder(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out"
    assert_fails(capsys, (CITY, "--variant", "scalar_rgb", "--out", out), "--out", "file/out")


def test_folder_with_other_results(capsys, copy):
    path = copy / "results.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "variant": "llvm_ad_rgb"}))
    assert_fails(capsys, (CITY, *FEW, "--out", copy), "--out", "variant llvm_ad_rgb")
    path.write_text("{}")
    assert_fails(capsys, (CITY, *FEW, "--out", copy), "results.json", "not results")


@pytest.mark.parametrize("spoil", ["size", "nan"])
def test_references_that_do_not_fit(capsys, tmp_path, scalar_variant, spoil):
    pixels = np.ones((18, 32 if spoil == "nan" else 16, 3), dtype=np.float32)
    if spoil == "nan":
        pixels[1, 2] = np.nan
    path = tmp_path / "reference.exr"
    mi.Bitmap(pixels).write(str(path))
    words = {"size": ("16 x 18", "32 x 18"), "nan": ("1 pixels", "not a number")}[spoil]
    arguments = (CITY, *FEW, "--reference", path, "--out", tmp_path / "out")
    assert_fails(capsys, arguments, "--reference", "reference.exr", *words)


def test_more_samples_than_the_reference_is_good_for(capsys, copy):
    before = (copy / "results.json").read_text()
    arguments = (CITY, *FEW, "--spp", 8, "--out", copy, "--time-budget", "0.02")
    assert_fails(capsys, arguments, "--spp 8", "128 samples")
    assert (copy / "results.json").read_text() == before


def test_results_of_finished_scenes_are_kept_if_a_later_one_fails(capsys, tmp_path):
    bad = tmp_path / "bad.xml"
    bad.write_text('<scene version="3.0.0"><shape type="nothing"/></scene>')
    first = f"open_plane:2,{TINY}"
    assert_fails(capsys, (first, bad, *FEW, "--out", tmp_path / "out"), "bad.xml", "nothing")
    data = json.loads((tmp_path / "out" / "results.json").read_text())
    assert data["scenes"][0]["series"][0]["points"][0]["seed"] == [1, 2]


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_ctrl_c_keeps_results_and_the_same_command_goes_on(tmp_path, variant):
    variant = require_variant(variant)
    out = tmp_path / "out"
    # Enough seeds to be still at work when the signal comes.
    arguments = ["bench", CITY, "--methods", "uniform,power", "--spp", "1,2", "--out", out]
    command = [sys.executable, "-m", "manylights", *arguments, "--variant", variant]
    process = subprocess.Popen(
        [*map(str, command), "--seeds", "100000"],
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
    )
    try:
        deadline = time.monotonic() + 240
        while not (out / "results.json").exists() or seeds_of(out) < 2:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(timeout=60) == 130
        assert b"interrupted" in process.stderr.read()
    finally:
        process.kill()
        process.stderr.close()
    assert not list(out.rglob("*.partial"))
    before = json.loads((out / "results.json").read_text())["scenes"][0]
    seeds = seeds_of(out) + 2
    status = main([*map(str, arguments), "--variant", variant, "--seeds", str(seeds)])
    assert status == 0
    after = json.loads((out / "results.json").read_text())["scenes"][0]
    for series, earlier in zip(after["series"], before["series"]):
        for point, old in zip(series["points"], earlier["points"]):
            assert point["seed"] == list(range(1, seeds + 1))
            assert point["seconds"][: len(old["seconds"])] == old["seconds"]


def seeds_of(out):
    """The number of seeds that the first series has."""
    scenes = json.loads((out / "results.json").read_text())["scenes"]
    series = scenes[0]["series"] if scenes else []
    return len(series[0]["points"][0]["seed"]) if series else 0


@pytest.mark.parametrize(
    ("text", "spec", "key"),
    [
        ("uniform", "uniform", "uniform"),
        ("talk:splitting_rate=4", "talk:splitting_rate=4", "talk-splitting_rate-4"),
        ("talk:splitting_rate=4.0", "talk:splitting_rate=4", "talk-splitting_rate-4"),
        ("talk:splitting_rate=inf", "talk:splitting_rate=inf", "talk-splitting_rate-inf"),
        ("resampled_tree:reservoirs=16:shadow_rays=8",) * 2
        + ("resampled_tree-reservoirs-16-shadow_rays-8",),
    ],
)
def test_methods_are_read_and_written(text, spec, key):
    method = methods.parse(text)
    assert (method.spec, method.key) == (spec, key)
    assert methods.parse(method.spec) == method
    json.dumps(method.parameters, allow_nan=False)


@pytest.mark.parametrize(
    ("plugin", "media", "peer", "ours", "depth"),
    [
        ("direct", False, "direct", "manylights_direct", 2),
        ("manylights_direct", False, "direct", "manylights_direct", 2),
        ("path", False, "path", "manylights_volpath", 6),
        ("path", True, "volpath", "manylights_volpath", 6),
        ("volpath", True, "volpath", "manylights_volpath", 6),
        ("volpathmis", True, "volpathmis", "manylights_volpath", 6),
        ("manylights_volpath", False, "path", "manylights_volpath", 6),
    ],
)
def test_kinds_of_integrators(plugin, media, peer, ours, depth):
    parameters = {"max_depth": 6, "hide_emitters": True, "bsdf_samples": 1}
    kind = methods.kind_of(plugin, parameters, media)
    assert (kind.peer, kind.ours, kind.max_depth) == (peer, ours, depth)
    assert methods.integrator_for(Method("uniform"), kind)["hide_emitters"] is True
    assert methods.integrator_for(Method("tree"), kind)["method"] == "tree"


def test_paths_without_a_limit():
    assert Kind("path").max_depth is None


def test_file_and_what_it_refers_to_make_the_hash(tmp_path, scalar_variant):
    shutil.copy(SCENES / "points.xml", tmp_path / "scene.xml")
    text = (tmp_path / "scene.xml").read_text()
    extra = '<shape type="ply"><string name="filename" value="a.ply"/></shape></scene>'
    (tmp_path / "scene.xml").write_text(text.replace("</scene>", extra))
    prints = []
    for content in ("one", "two", "two"):
        (tmp_path / "a.ply").write_text(content)
        prints.append(scene_source.find(str(tmp_path / "scene.xml")).fingerprint)
    assert prints[0] != prints[1] == prints[2]


def test_sources_of_generators(scalar_variant):
    source = scene_source.find(f"rooms:20,integrator=path,max_depth=4,{TINY}")
    loaded = source.load()
    assert loaded.size == (32, 18) and loaded.lights == 20 and not loaded.media
    assert loaded.kind == Kind("path", {"max_depth": 4})
    other = scene_source.find(f"rooms:30,integrator=path,max_depth=4,{TINY}")
    assert other.family == source.family and other.fingerprint != source.fingerprint
    assert scene_source.find(f"on_emitter,{TINY}").load().lights == 6


SAMPLER_CLASSES = ("Independent", "Multijitter", "Orthogonal", "LowDiscrepancy", "Sobol")


def assert_sensors(loaded):
    """There is one sensor for each sampler, all alike."""
    names = [sensor.sampler().class_name() for sensor in loaded.sensors.values()]
    assert names == [f"{name}Sampler" for name in SAMPLER_CLASSES]
    assert list(loaded.sensors) == list(samplers.NAMES)
    places = [np.array(s.world_transform().matrix) for s in loaded.sensors.values()]
    assert all(np.array_equal(place, places[0]) for place in places)


def test_scenes_get_a_sensor_for_each_sampler(tmp_path, scalar_variant):
    text = (SCENES / "points.xml").read_text()
    path = tmp_path / "scene.xml"
    path.write_text(text.replace('"independent"', '"multijitter"'))
    assert 'sampler type="multijitter"' in path.read_text()
    assert_sensors(scene_source.find(str(path)).load())
    assert_sensors(scene_source.find(f"rooms:20,{TINY}").load())


def test_numbers_of_samples_that_are_not_rounded(scalar_variant):
    asked = [1, 3, 4, 16, 24, 64]
    for name, expected in (
        ("independent", asked),
        ("ldsampler", [1, 1, 4, 16, 16, 64]),
        ("manylights_sobol", asked),
    ):
        sampler = mi.load_dict({"type": name})
        assert [samplers.allowed(sampler, spp) for spp in asked] == expected


def test_the_best_sampler_is_chosen(scalar_variant):
    """By error times time, among those that do not round."""
    loaded = scene_source.find(f"rooms:20,{TINY}").load()
    noise = {"independent": (1.0, 1.0), "multijitter": (0.4, 2.0), "ldsampler": (0.6, 3.0)}
    asked = set()

    def render(name, spp, number):
        asked.add((name, spp))
        error, seconds = noise[name]
        image = np.full((4, 4, 3), 10.0) + (2 * number - 1) * error
        return Drawing(image, seconds, seconds)

    assert samplers.choose(loaded.sensors, [1, 4, 16], render) == "multijitter"
    assert asked == {(name, 16) for name in noise}
    assert samplers.choose(loaded.sensors, [1], render) == "independent"


def test_scenes_of_one_name_get_numbers(tmp_path, scalar_variant):
    sources = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        shutil.copy(SCENES / "points.xml", tmp_path / folder / "points.xml")
        sources.append(scene_source.find(str(tmp_path / folder / "points.xml")))
    found = open_folder(str(tmp_path / "out"), "scalar_rgb")
    names = [found.scene(source, name=source.name)["name"] for source in sources]
    assert names == ["points", "points_2"]
    assert found.scene(sources[1], name="points") is found.data["scenes"][1]


def test_files_called_scene_have_the_name_of_their_folder(tmp_path, scalar_variant):
    (tmp_path / "kitchen").mkdir()
    shutil.copy(SCENES / "points.xml", tmp_path / "kitchen" / "scene.xml")
    source = scene_source.find(str(tmp_path / "kitchen" / "scene.xml"))
    assert (source.name, source.text) == ("kitchen", "kitchen/scene.xml")


@pytest.mark.parametrize("jobs", [standard.standard, standard.quick])
def test_standard_sets_are_complete(llvm, jobs):
    found = jobs()
    names = [job.name for job in found]
    assert len(set(names)) == len(names)
    assert sum(job.boundary for job in found) == 1
    for job in found:
        assert {method.name for method in job.methods} == set(methods.NAMES)
        specs = [method.spec for method in job.methods]
        assert len(set(specs)) == len(specs)
    methods.check_values([method for job in found for method in job.methods])


def test_calibration_of_a_linear_time():
    def seconds(spp):
        return 0.02 + 0.01 * spp

    times = calibration.ladder(seconds, budget=0.5)
    assert list(times) == [1, 4, 16]
    assert calibration.samples_in(times, 0.5) == 48
    assert calibration.predict(times, 64) == pytest.approx(0.66)
    assert list(calibration.ladder(seconds, budget=0.5, largest=4)) == [1, 4]
    assert list(calibration.ladder(seconds, budget=0.02)) == [1, 4]
    assert list(calibration.ladder(seconds, budget=0.001)) == [1]
    assert calibration.samples_in({1: 0.1}, 0.05) == 1


def test_moments_are_those_of_numpy_and_count_a_seed_once(tmp_path):
    images = np.random.default_rng(1).normal(3.0, 2.0, (5, 4, 6, 3))
    moments = Moments()
    for seed, image in enumerate(images):
        moments.add(seed, image)
        moments.save(tmp_path / "m.npz")
        moments = Moments.load(tmp_path / "m.npz")
        moments.add(seed, image)
    np.testing.assert_allclose(moments.mean, images.mean(axis=0))
    np.testing.assert_allclose(moments.variance(), images.var(axis=0, ddof=1))


def test_workload_reaches_one():
    fractions = []
    work = Workload({"a": 10.0, "b": 10.0}, fractions.append)
    work.finish("a", 5.0)
    work.expect("a", 15.0)
    work.finish("a", 15.0)
    work.expect("b", 0.0)
    work.finish("b", 0.0)
    assert fractions == pytest.approx([0.25, 2 / 3, 1.0])


def test_every_method_is_described():
    assert set(methods.ABOUT) == set(methods.NAMES) == {*methods.MITSUBAS, *methods.OURS}
    assert len({about.color for about in methods.ABOUT.values()}) == len(methods.NAMES)
    assert len({about.marker for about in methods.ABOUT.values()}) == len(methods.NAMES)


def test_a_new_point_has_a_list_a_seed():
    point = records.new_point(4)
    assert point.pop("spp") == 4
    assert set(point) == POINT_KEYS - {"spp"} and not any(point.values())


def test_the_missing_extra_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert_fails(capsys, (CITY, "--out", tmp_path), "flip-evaluator", "manylights[bench]")


def test_importing_the_package_imports_no_extra():
    code = (
        "import sys; from manylights.cli.main import parser; parser(); "
        "extras = ('matplotlib', 'scipy', 'jinja2', 'flip_evaluator'); "
        "print(*[name for name in extras if name in sys.modules])"
    )
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


def test_a_method_with_broken_pixels_is_left_out(tmp_path, monkeypatch):
    render = drawing._render

    def spoilt(loaded, integrator, spp, seed, sampler):
        pixels = render(loaded, integrator, spp, seed, sampler)
        if seed == 2 and not str(integrator).startswith("ManyLights"):
            pixels[3, 4] = np.nan
        return pixels

    monkeypatch.setattr(drawing, "_render", spoilt)
    status, data = bench(tmp_path, CITY, *FEW, "--methods", "uniform,resampled_tree")
    assert status == 0
    scene = data["scenes"][0]
    assert scene["skipped"][0]["spec"] == "uniform"
    assert "1 pixels are not finite" in scene["skipped"][0]["why"]
    assert series_by_spec(scene)["resampled_tree"]["points"][0]["seed"] == [1, 2]


def test_denoised_images_are_measured_too(tmp_path):
    pytest.importorskip("mitsuba_oidn")
    _, data = bench(tmp_path, CITY, *FEW)
    plain = data["scenes"][0]["series"]
    _, data = bench(tmp_path, CITY, *FEW, "--denoise")
    for before, series in zip(plain, data["scenes"][0]["series"]):
        assert series["points"] == before["points"]
        assert [point["spp"] for point in series["denoised"]] == [1, 2]
        for point in series["denoised"]:
            assert point["seed"] == [1, 2] and set(point) == POINT_KEYS
        if series["method"] == "power":
            clean, noisy = (series[kind][0]["error_trimmed"] for kind in ("denoised", "points"))
            assert np.mean(clean) < 0.7 * np.mean(noisy)
    before = (tmp_path / "results.json").read_bytes()
    bench(tmp_path, CITY, *FEW, "--denoise")
    assert (tmp_path / "results.json").read_bytes() == before


def test_the_missing_denoiser_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert_fails(capsys, (CITY, "--denoise", "--out", tmp_path), "mitsuba-oidn")


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("name", ["uniform", "resampled_tree"])
def test_the_denoiser_gets_what_is_in_sight(name, alpha, scalar_variant, monkeypatch):
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}}
    lamp["to_world"] = mi.ScalarTransform4f().translate([0, 0, 1]).scale([1, 0.3, 1])
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    film["pixel_format"] = "rgba" if alpha else "rgb"
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    sensor = {"type": "perspective", "fov": 30.0, "to_world": to_world, "film": film}
    wall = {"type": "rectangle", "bsdf": bsdf, "to_world": mi.ScalarTransform4f().scale(3)}
    other = lamp | {"to_world": mi.ScalarTransform4f().translate([0, 3, 3]).rotate([1, 0, 0], 90)}
    scene = {"type": "scene", "sensor": sensor, "wall": wall, "lamp": lamp, "other": other}
    loaded = SimpleNamespace(
        scene=mi.load_dict(scene), sensors={"own": 0}, size=(8, 8), kind=Kind("direct")
    )
    given = {}

    def denoised(image, names):
        given.update({name: image[..., index] for index, name in enumerate(names)})
        return image[..., :3]

    monkeypatch.setattr(drawing.denoise, "denoised", denoised)
    description = methods.integrator_for(Method(name), loaded.kind)
    guided = mi.load_dict(methods.with_guides(description))
    image = drawing.draw_denoised(loaded, guided, 4, 1, "own").image
    names = ["R", "G", "B", "emission.R", "emission.G", "emission.B"]
    names += ["albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y", "normal.Z"]
    assert list(given) == names
    np.testing.assert_array_equal(image[..., 0], given["R"])
    plain = drawing.draw(loaded, mi.load_dict(description), 4, 1, "own").image
    np.testing.assert_allclose(plain.mean(), image.mean(), rtol=0.3)
    in_sight = given["emission.G"]
    assert in_sight[4, 4] == pytest.approx(3.0) and in_sight[0, 4] == 0.0
    assert given["albedo.B"][0, 4] == pytest.approx(0.6, abs=0.01)
    assert given["normal.Z"][0, 4] == pytest.approx(1.0, abs=0.01)


def test_unknown_generator_is_a_usage_error():
    with pytest.raises(UsageError, match="neither an XML file"):
        scene_source.find("nothing")
    assert "city" in manylights.scenes.names()

"""`manylights render --part` and `manylights merge`: the bits of one render, and refusals."""

import itertools
import json
import random
import shlex
import shutil
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import cli, loading
from manylights.errors import UsageError
from manylights.output import exr
from manylights.rendering import job, plan, state_file
from manylights.rendering.driver import Driver
from manylights.rendering.parts import Part, Run, gaps, steps_of
from manylights.rendering.plan import Limits
from manylights.rendering.targets import Course, History

from tests.conftest import require_variant

pytestmark = pytest.mark.usefixtures("plugin")

SCENES = Path(__file__).parent.parent / "scenes"

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]

#: Options for what is not ours.
MITSUBAS = ("--integrator", "path", "--sampler", "independent")


@pytest.fixture(scope="module", autouse=True)
def short_steps():
    """Also small images are rendered in many steps: of 1024 samples at most."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "SINGLE_STEP_SAMPLES", 0)
        patch.setattr(plan, "MOST_SAMPLES", dict.fromkeys(plan.MOST_SAMPLES, 2**10))
        yield


def write_scene(path, name="many_bulbs", filter_type="gaussian", pixel_format="rgb"):
    """Write a scene of the folder with another filter, and return its path."""
    text = (SCENES / f"{name}.xml").read_text()
    assert '<rfilter type="box"/>' in text
    text = text.replace('<rfilter type="box"/>', f'<rfilter type="{filter_type}"/>')
    film = f'<film type="hdrfilm"><string name="pixel_format" value="{pixel_format}"/>'
    lines = [line for line in text.splitlines() if 'name="pixel_format"' not in line]
    if not (path.parent / "data").exists():
        (path.parent / "data").symlink_to(SCENES / "data")
    path.write_text("\n".join(lines).replace('<film type="hdrfilm">', film))
    return path


@pytest.fixture
def scene(tmp_path):
    """A scene with a filter that is wider than a pixel."""
    return write_scene(tmp_path / "scene.xml")


def main(*arguments):
    """Run the command in this process; return the exit status."""
    return cli.main(list(map(str, arguments)))


def render_options(variant="scalar_rgb", seed=5):
    """Options of a small render of 19 steps."""
    options = ("--variant", variant, "--spp", 37, "--seed", seed, "--threads", 1)
    return (*options, "-D", "resx=28", "-D", "resy=18")


@pytest.fixture
def run(scene, tmp_path, capsys):
    """A function that runs `render` (19 steps) or `merge`; returns exit status and log."""

    def call(*arguments):
        return main(*arguments), capsys.readouterr().err

    def render(*arguments, variant="scalar_rgb", out="a.exr", path=scene, seed=5):
        options = render_options(variant, seed)
        return call("render", path, "-o", tmp_path / out, *options, *arguments)

    def merge(*arguments, out="merged.exr"):
        return call("merge", *arguments, "-o", tmp_path / out)

    render.merge = merge
    return render


@pytest.fixture
def parts(run, tmp_path):
    """A function that renders all parts, and returns their files."""

    def render(count, *arguments, **options):
        for number in range(1, count + 1):
            status, log = run("--part", f"{number}/{count}", *arguments, **options)
            assert status == 0, log
        stem = options.get("out", "a.exr").removesuffix(".exr")
        return sorted(tmp_path.glob(f"{stem}.part-*-of-{count:02}.exr"))

    return render


def content(path):
    """Names of channels, and the bytes of the pixels."""
    bitmap = mi.Bitmap(str(path))
    return [field.name for field in bitmap.struct_()], np.array(bitmap).tobytes()


def data(path):
    """The channels of an image and the bytes of their pixels, and those of its preview."""
    planes, _ = exr.read(path)
    pixels = {name: (plane.dtype.name, plane.tobytes()) for name, plane in planes.items()}
    return pixels, path.with_suffix(".png").read_bytes()


# ---------------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize("spp", [1, 2, 37, 64, 1000])
@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("count", [1, 2, 7, 16, 40])
def test_parts_have_each_step_once(spp, indexed, count):
    limits = Limits(500, indexed=indexed)
    found, samples = [], 0
    for number in range(1, count + 1):
        course, done = Course(spp, limits, part=Part(number, count)), History([0])
        while (step := course.next_step(done)) is not None:
            found.append(step)
            done.add(step, 0.0)
        assert done.steps == course.part.steps(course.step_count)
        assert done.spp == course.predicted_spp([])
        samples += done.spp
    steps = list(plan.steps(spp, limits))
    assert sorted(found, key=lambda step: step.index) == steps and samples == spp
    assert len(steps) == plan.step_count(spp, limits)


def test_parts_of_a_single_step(monkeypatch):
    monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", 2**20)
    limits = Limits(500)
    first, second = (Course(9, limits, part=Part(number, 2)) for number in (1, 2))
    assert first.next_step(History([0])) == plan.Step((), 9, 0, 0)
    assert second.next_step(History([0])) is None and second.training(History([0])) is None


@pytest.mark.parametrize(
    ("there", "words"),
    [
        ([(1, 1, 10)], ""),
        ([(1, 4, 3), (3, 4, 2)], "parts 2 and 4 of 4"),
        ([(1, 2, 5), (2, 4, 3)], "part 4 of 4"),
        ([(1, 2, 5)], "part 2 of 2"),
        ([(1, 2, 5), (2, 4, 3), (4, 4, 2)], ""),
        ([(1, 3, 2), (2, 3, 3)], "part 3 of 3, the rest of part 1 of 3 (2 of its 4 steps)"),
        ([(1, 16, 1), (3, 16, 1)], "parts 2, 4, 5, 6, 7, 8, 9 and 10 of 16"),
    ],
)
def test_what_is_missing_of_ten_steps_has_words(there, words):
    runs = [Run(Part(number, count), done) for number, count, done in there]
    assert gaps(runs, 10).words(10) == words
    assert bool(words) == (steps_of(runs, 10) == 0).any()


@pytest.mark.parametrize("wrong", ["3", "0/4", "5/4", "-1/4", "a/b", "1/2/3", "1/99999999"])
def test_part_that_is_none_is_refused(run, capsys, wrong):
    with pytest.raises(SystemExit) as raised:
        run("--part", wrong)
    assert raised.value.code == 2 and "--part" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [(0, 4), (5, 4), (1,), 3, (1.0, 4), (True, 4), "3/4"])
def test_part_in_python_that_is_none_is_refused(scene, scalar, wrong):
    with pytest.raises(
        UsageError, match=r"must be two integers, 1 <= K <= N <= 1048576, \(3, 16\) is"
    ):
        manylights.render(str(scene), part=wrong)


# ---------------------------------------------------------------------------------- the same bits


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("filter_type", ["gaussian", "box"])
def test_parts_in_any_order_and_grouping_give_the_bits_of_the_whole(
    run, parts, scene, tmp_path, variant, filter_type
):
    """The scene learns visibility; the parts begin with what the whole has learnt."""
    variant = require_variant(variant)
    write_scene(scene, filter_type=filter_type)
    assert run(variant=variant, out="whole.exr")[0] == 0
    expected = content(tmp_path / "whole.exr")
    files = parts(4, variant=variant)
    assert [path.name for path in files] == [f"a.part-0{n}-of-04.exr" for n in range(1, 5)]
    assert all(state_file.read(path, "", "")[0].state.learnt.any() for path in files)
    # One variant merges what another one rendered.
    for order in (files, files[::-1], [files[i] for i in (2, 0, 3, 1)]):
        status, log = run.merge(*order)
        assert status == 0 and "merged 4 files, 37 samples per pixel, wrote" in log
        assert content(tmp_path / "merged.exr") == expected
    assert data(tmp_path / "merged.exr") == data(tmp_path / "whole.exr")
    assert run.merge("--partial", files[3], files[1], out="first.exr")[0] == 0
    assert run.merge("--partial", files[0], tmp_path / "first.exr", out="second.exr")[0] == 0
    assert run.merge(files[2], tmp_path / "second.exr", out="last.exr")[0] == 0
    assert content(tmp_path / "last.exr") == expected


@pytest.mark.parametrize("variant", VARIANTS)
def test_one_part_and_parts_of_several_sizes_give_the_bits_of_the_whole(
    run, parts, tmp_path, variant
):
    variant = require_variant(variant)
    assert run(variant=variant, out="whole.exr")[0] == 0
    expected = content(tmp_path / "whole.exr")
    assert run.merge(*parts(1, variant=variant))[0] == 0
    assert content(tmp_path / "merged.exr") == expected
    files = parts(2, variant=variant)[:1]
    for part in ("2/4", "4/4"):
        assert run("--part", part, variant=variant)[0] == 0
    files += [tmp_path / f"a.part-{part}-of-04.exr" for part in ("02", "04")]
    assert run.merge(*random.Random(2).sample(files, 3), out="mixed.exr")[0] == 0
    assert content(tmp_path / "mixed.exr") == expected


def test_more_parts_than_steps_leave_some_empty(run, parts, tmp_path):
    assert run("--spp", 5, out="whole.exr")[0] == 0
    files = parts(4, "--spp", 5)
    log = run("--spp", 5, "--part", "4/4")[1]
    assert "this render has 3 steps, part 4 of 4 is empty, at most 3 share the work" in log
    assert run.merge(*files[::-1])[0] == 0
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")
    assert "no samples yet" in run.merge("--partial", files[3])[1]


def test_renders_of_one_step_can_be_parted(run, parts, tmp_path, monkeypatch):
    monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", 2**22)
    assert run(out="whole.exr")[0] == 0
    files = parts(2)
    assert run.merge(*files)[0] == 0
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")


@pytest.mark.parametrize(
    ("variant", "name", "pixel_format", "arguments"),
    [
        ("scalar_rgb", "aov", "rgba", ()),
        ("llvm_ad_rgb", "aov", "luminance_alpha", ()),
        ("llvm_ad_mono_polarized", "many_bulbs", "rgb", MITSUBAS),
        ("scalar_spectral", "many_bulbs", "xyz", MITSUBAS),
        ("scalar_rgb", "many_bulbs", "rgb", ("--sampler", "multijitter")),
        ("llvm_ad_rgb", "many_bulbs", "rgb", ("--sampler", "independent")),
        ("llvm_ad_rgb", "points", "rgb", ("--integrator", "ptracer", "--spp", 64)),
        ("scalar_rgb", "many_bulbs", "xyza", ("--set", "learn_visibility=false")),
    ],
)
def test_films_samplers_and_integrators_keep_their_bits(
    run, parts, scene, tmp_path, variant, name, pixel_format, arguments
):
    variant = require_variant(variant)
    write_scene(scene, name, pixel_format=pixel_format)
    assert run(*arguments, variant=variant, out="whole.exr")[0] == 0
    assert run.merge(*parts(3, *arguments, variant=variant)[::-1])[0] == 0
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")


@pytest.mark.parametrize("variant", VARIANTS)
def test_small_last_steps_use_what_larger_ones_learnt(run, parts, tmp_path, monkeypatch, variant):
    """Its size follows the samples of the whole render, not those of a step."""
    variant = require_variant(variant)
    monkeypatch.setattr(plan, "MOST_SAMPLES", dict.fromkeys(plan.MOST_SAMPLES, 2**14))
    arguments = ("--spp", 70, "--sampler", "independent")
    assert run(*arguments, variant=variant, out="whole.exr")[0] == 0
    for number in range(1, 6):
        learnt = ("--learnt", tmp_path / "a.part-01-of-05.exr") if number > 1 else ()
        assert run(*arguments, "--part", f"{number}/5", *learnt, variant=variant)[0] == 0
    assert run.merge(*tmp_path.glob("a.part-*.exr"))[0] == 0
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")


def test_exposure_is_that_of_the_whole(tmp_path, scalar, scene):
    """A factor that USD cameras have."""

    def load():
        loaded = manylights.loading.load(str(scene), {"resx": "28", "resy": "18"})
        loaded.exposure = 0.3
        return loaded

    whole = manylights.render(load(), spp=7, output=tmp_path / "whole.exr")
    for number in (1, 2):
        manylights.render(load(), spp=7, output=tmp_path / "a.exr", part=(number, 2))
    merged = manylights.merge(tmp_path.glob("a.part-*.exr"), tmp_path / "merged.exr")
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")
    assert merged.samples == whole.samples == 7 and not merged.missing


def test_python_has_parts_too(tmp_path, scene, scalar):
    whole = manylights.render(str(scene), spp=3)
    results = [
        manylights.render(str(scene), spp=3, output=tmp_path / "a.exr", part=(number, 3))
        for number in (1, 2, 3)
    ]
    files = [path for result in results for path in result.files]
    assert [path.name for path in files] == [f"a.part-0{n}-of-03.exr" for n in (1, 2, 3)]
    assert sum(result.samples for result in results) == 3
    merged = manylights.merge(files)
    assert np.array(merged.bitmap).tobytes() == whole.image.tobytes() and not merged.files


# ------------------------------------------------------------------------------------ interrupted


def interrupted(monkeypatch, render, *arguments, done):
    """Render until so many steps are done: that is what a part's file has then."""
    render_step, seen = Driver.render, []

    def render_first(driver, step, seed, spp, report):
        if step.spp and any(one.role != plan.TRAIN for one in step.passes):
            if len(seen) == done:
                raise RuntimeError("interrupted by the test")
            seen.append(step)
        return render_step(driver, step, seed, spp, report)

    with monkeypatch.context() as patch:
        patch.setattr(Driver, "render", render_first)
        status, log = render(*arguments)
    assert status == 2 and "interrupted by the test" in log


@pytest.mark.parametrize("number", [1, 2])
def test_parts_resume_themselves(run, parts, monkeypatch, tmp_path, number):
    assert run(out="whole.exr")[0] == 0
    arguments = ("--checkpoint", 1e-6, "--part", f"{number}/2")
    interrupted(monkeypatch, run, *arguments, done=4)
    file = tmp_path / f"a.part-0{number}-of-02.exr"
    other = 3 - number
    assert run("--part", f"{other}/2")[0] == 0
    status, log = run.merge(*sorted(tmp_path.glob("a.part-*.exr")))
    assert status == 2 and f"missing: the rest of part {number} of 2 (4 of its" in log
    assert f"--part {number}/2" in log and "goes on with part" in log
    status, log = run(*arguments)
    assert status == 0 and f"{file} has 8 of" in log
    status, log = run(*arguments)
    assert status == 0 and "goes on from there" in log
    assert run.merge(*tmp_path.glob("a.part-*.exr"))[0] == 0
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")
    assert not list(tmp_path.glob("*.checkpoint.exr"))


def test_part_does_not_go_on_from_another_one(run, tmp_path):
    assert run("--part", "1/2")[0] == 0
    (tmp_path / "a.part-01-of-02.exr").rename(tmp_path / "a.part-02-of-02.exr")
    status, log = run("--part", "2/2", "--checkpoint", 1)
    assert status == 2 and "part 1/2 and not 2/2" in log


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_learnt_can_come_from_a_file(run, parts, tmp_path, monkeypatch, variant):
    variant = require_variant(variant)
    assert run(variant=variant, out="whole.exr")[0] == 0
    assert run("--part", "1/2", variant=variant)[0] == 0
    trained = []
    render_step = Driver.render

    def watch(driver, step, *others):
        trained.append(any(one.role == plan.TRAIN for one in step.passes))
        return render_step(driver, step, *others)

    monkeypatch.setattr(Driver, "render", watch)
    learnt = tmp_path / "a.part-01-of-02.exr"
    assert run("--part", "2/2", "--learnt", learnt, variant=variant)[0] == 0
    assert not any(trained)
    assert run.merge(*tmp_path.glob("a.part-*.exr"))[0] == 0
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")


def test_what_is_learnt_is_refused_of_another_render(run, tmp_path):
    learnt = tmp_path / "a.part-01-of-02.exr"
    arguments = ("--part", "2/2", "--learnt", learnt)
    assert f"{learnt}: no such file" in run(*arguments)[1]
    assert run("--part", "1/2", seed=8)[0] == 0
    status, log = run(*arguments)
    assert status == 2 and f"{learnt}: of another render. It has seed 8 and not 5" in log
    assert run(out="a.exr")[0] == 0
    assert "nothing was learnt" in run("--part", "2/2", "--learnt", tmp_path / "a.exr")[1]
    assert "learnt" in run("--learnt", learnt)[1]


def test_targets_have_no_parts(run):
    for target in (("--until-noise", 0.1), ("--for", "1s")):
        status, log = run("--part", "1/2", *target)
        assert status == 2 and "part 1 of 2: needs a fixed number of samples" in log


# --------------------------------------------------------------------------------------- refusals


@pytest.fixture(scope="module")
def rendered_parts(tmp_path_factory):
    """Both parts of a render, not to be changed."""
    folder = tmp_path_factory.mktemp("two")
    scene = write_scene(folder / "scene.xml")
    for number in (1, 2):
        part = ("--part", f"{number}/2", "-o", folder / "a.exr")
        assert main("render", scene, *render_options(), *part) == 0
    return sorted(folder.glob("a.part-*.exr"))


@pytest.fixture
def two(rendered_parts, scene, tmp_path):
    """Copies of them, beside the scene."""
    return [Path(shutil.copy(path, tmp_path)) for path in rendered_parts]


def test_missing_parts_are_named_with_the_command(run, parts, scene, tmp_path):
    files = parts(6)
    status, log = run.merge(files[5], files[0], files[2], files[4])
    assert status == 2 and "missing: parts 2 and 4 of 6; this renders part 2: manylights" in log
    assert not (tmp_path / "merged.exr").exists()
    command = shlex.split(log.partition("this renders part 2: ")[2].partition(" (--partial")[0])
    assert command[0] == "manylights" and command[-2:] == ["--part", "2/6"]
    before = content(files[1])
    files[1].unlink()
    assert cli.main(command[1:]) == 0 and content(files[1]) == before


def test_parts_that_come_twice_are_refused(run, two, parts, tmp_path):
    copy = tmp_path / "copy.exr"
    shutil.copy(two[0], copy)
    status, log = run.merge(*two, copy)
    assert status == 2 and f"part 1 of 2 comes twice: in {two[0]} and in {copy}" in log
    assert run.merge(two[0], copy, "--partial")[0] == 2
    four = parts(4)
    status, log = run.merge(two[0], four[2])
    assert status == 2 and f"comes twice: in {two[0]} and in {four[2]}" in log
    assert run.merge("--partial", *four[:2], out="some.exr")[0] == 0
    status, log = run.merge(tmp_path / "some.exr", four[1])
    assert status == 2 and "part 2 of 4 comes twice" in log


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--spp", 36), "spp 36 and not 37"),
        (("--seed", 6), "seed 6 and not 5"),
        (("--variant", "llvm_ad_rgb"), "variant llvm_ad_rgb and not scalar_rgb"),
        (("--set", "shadow_rays=2"), "set shadow_rays=2 and not none"),
        (("-D", "resx=20"), "size 20 x 18 and not 28 x 18"),
    ],
)
def test_parts_of_another_render_are_refused(run, two, tmp_path, change, words):
    require_variant("llvm_ad_rgb")
    assert run("--part", "2/2", *change, out="other.exr")[0] == 0
    other = tmp_path / "other.part-02-of-02.exr"
    status, log = run.merge(two[0], other)
    assert status == 2 and f"{other}: not of the render of {two[0]}" in log and words in log


def test_parts_of_another_scene_or_version_are_refused(run, two, scene, monkeypatch):
    scene.write_text(scene.read_text() + "\n")
    assert run("--part", "2/2")[0] == 0
    assert "another content of scene.xml" in run.merge(*two)[1]
    monkeypatch.setattr("manylights.__version__", "99")
    assert run("--part", "2/2")[0] == 0
    assert "version manylights 99" in run.merge(*two)[1]


@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.999])
def test_truncated_files_are_named(run, two, part):
    data = two[1].read_bytes()
    two[1].write_bytes(data[: int(part * len(data))])
    status, log = run.merge(*two)
    assert status == 2 and f"{two[1]}: not a whole part or image" in log


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("runs", [[1, 2, 999999]]),
        ("runs", [[3, 2, 1]]),
        ("runs", [[1, 2]]),
        ("runs", "all"),
        ("channels", ["R", "Z"]),
        ("channels", []),
        ("sequences", 3),
        ("history", {"samples": [1, 2]}),
        ("history", {"sample": [1]}),
        ("learnt", "AAAA"),
        ("learnt", "no base64"),
        ("step_count", "many"),
        ("step_count", 10**12),
        ("step_count", 1.5),
    ],
)
def test_files_that_make_no_sense_are_named(run, two, name, value):
    bitmap = mi.Bitmap(str(two[1]))
    bitmap.metadata()[f"manylights.{name}"] = json.dumps(value)
    bitmap.write(str(two[1]))
    status, log = run.merge(*two)
    assert status == 2 and f"{two[1]}: not a whole part or image" in log
    assert "checksum" not in log


def test_changed_bits_are_found(run, two, tmp_path):
    """Anywhere: in the sums or in what is said of them, or in what nobody reads."""
    assert run.merge(*two)[0] == 0
    expected = content(tmp_path / "merged.exr")
    whole, places = two[1].read_bytes(), np.random.default_rng(4)
    found = 0
    for place in places.integers(len(whole), size=40):
        changed = bytearray(whole)
        changed[place] ^= 1 << int(places.integers(8))
        two[1].write_bytes(changed)
        status, log = run.merge(*two)
        assert status == 2 or content(tmp_path / "merged.exr") == expected
        assert status == 0 or str(two[1]) in log
        found += status == 2
    assert found > 20


def test_another_format_is_told(run, two, monkeypatch):
    monkeypatch.setattr("manylights.rendering.state_file.FORMAT", 2)
    status, log = run.merge(*two)
    assert status == 2 and "(format 3 and not 2, written by manylights" in log


def test_other_images_are_no_parts(run, two, tmp_path):
    other = tmp_path / "other.exr"
    mi.Bitmap(np.zeros((18, 28, 3), np.float32)).write(str(other))
    status, log = run.merge(two[0], other)
    assert status == 2 and f"{other}: not a part or image of manylights" in log
    assert f"{tmp_path}/nothing.exr: no such file" in run.merge(tmp_path / "nothing.exr")[1]


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        ("a.exr", "paths 'a.exr': must be a list of paths"),
        (None, "paths None: must be a list of paths"),
        ([3], "paths 3: must be a path"),
        (["a.exr"], "^a.exr: no such file$"),
    ],
)
def test_what_are_no_paths_is_named(scalar, paths, words):
    with pytest.raises(UsageError, match=words):
        manylights.merge(paths)


def test_renders_with_a_target_are_no_parts(run, monkeypatch, tmp_path):
    kept = tmp_path / "a.checkpoint.exr"
    interrupted(monkeypatch, run, "--until-noise", 0.001, "--checkpoint", 1e-6, done=3)
    status, log = run.merge(kept)
    assert status == 2 and f"{kept}: of a render with a target" in log


# ---------------------------------------------------------------------------- partly, and averages


def test_partial_merges_are_as_bright(run, parts, tmp_path):
    """The mean of independent thirds is the whole; each is as bright but for its noise."""
    assert run("--spp", 96, out="whole.exr")[0] == 0
    whole = np.array(mi.Bitmap(str(tmp_path / "whole.exr")))
    files = parts(3, "--spp", 96)
    means = []
    for pair in itertools.combinations(files, 2):
        status, log = run.merge("--partial", *pair)
        assert status == 0 and "64 samples per pixel (missing: part" in log
        saved, _ = state_file.read(tmp_path / "merged.exr", "", "")
        assert saved.state.history.spp == 64
        image = saved.state.sums[0].rounded
        means.append((image[..., :3] / image[..., 3:4]).mean())
        assert means[-1] == pytest.approx(whole.mean(), rel=0.1)
    assert np.mean(means) == pytest.approx(whole.mean(), rel=0.01)


def test_checkpoint_of_a_whole_render_is_a_part(run, monkeypatch, tmp_path):
    interrupted(monkeypatch, run, "--checkpoint", 1e-6, done=3)
    kept = tmp_path / "a.checkpoint.exr"
    status, log = run.merge(kept)
    assert status == 2 and "missing: the rest of part 1 of 1 (3 of its" in log
    status, log = run.merge("--partial", kept)
    assert status == 0 and "6 samples per pixel" in log


def told(path):
    """The attributes of a file, but for how long it took, as something to compare."""
    _, attributes = exr.read(path)
    del attributes["manylights.seconds_taken"]
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in attributes.items()
    }


def test_merged_parts_say_what_the_whole_says(run, two, tmp_path):
    """Also where the camera was, and what the integrator's parameters are."""
    assert run(out="whole.exr")[0] == 0
    assert run.merge(*two)[0] == 0
    whole = told(tmp_path / "whole.exr")
    assert {"worldToCamera", "worldToNDC", "chromaticities", "software"} <= whole.keys()
    assert "manylights.parameters" in whole and whole["manylights.samples"] == 37
    assert told(tmp_path / "merged.exr") == whole
    # Merged in groups it is the same
    assert run.merge(two[0], "--partial", out="first.exr")[0] == 0
    assert run.merge(tmp_path / "first.exr", two[1])[0] == 0
    assert told(tmp_path / "merged.exr") == whole


def test_means_say_what_all_their_images_say(run, tmp_path):
    for seed, spp in ((1, 4), (2, 8)):
        assert run("--spp", spp, out=f"{seed}.exr", seed=seed)[0] == 0
    files = [tmp_path / "1.exr", tmp_path / "2.exr"]
    assert run.merge(*files)[0] == 0
    first, mean = told(files[0]), told(tmp_path / "merged.exr")
    assert mean["manylights.samples"] == 12 and exr.fact(mean["manylights.seeds"]) == [1, 2]
    differing = {name for name in {**first, **mean} if first.get(name) != mean.get(name)}
    assert differing == {"manylights.samples", "manylights.samples_done", "manylights.seeds"}
    # Another camera, as of a program that wrote the file anew
    planes, attributes = exr.read(files[1])
    attributes["worldToCamera"] = 2 * attributes["worldToCamera"]
    exr.write(files[1], planes, attributes)
    assert run.merge(*files)[0] == 0
    again = told(tmp_path / "merged.exr")
    assert "worldToCamera" not in again and again["worldToNDC"] == mean["worldToNDC"]


def test_images_of_several_seeds_are_averaged_by_samples(run, tmp_path):
    for seed, spp in ((1, 8), (2, 24), (3, 4)):
        assert run("--spp", spp, out=f"s{seed}.exr", seed=seed)[0] == 0
    files = [tmp_path / f"s{seed}.exr" for seed in (1, 2, 3)]
    status, log = run.merge(*files[:2], out="pair.exr")
    assert status == 0 and "32 samples per pixel" in log and "the mean of 2" in log
    assert run.merge(tmp_path / "pair.exr", files[2])[0] == 0
    images = [np.array(mi.Bitmap(str(path)), np.float64) for path in files]
    expected = (8 * images[0] + 24 * images[1] + 4 * images[2]) / 36
    merged = np.array(mi.Bitmap(str(tmp_path / "merged.exr")))
    np.testing.assert_allclose(merged, expected, rtol=1e-6)
    status, log = run.merge(tmp_path / "pair.exr", files[1])
    assert (
        status == 2 and f"seed 2 comes twice: in {tmp_path / 'pair.exr'} and in {files[1]}" in log
    )


@pytest.mark.parametrize(("name", "value"), [("seeds", []), ("samples_done", 0)])
def test_images_that_make_no_sense_are_named(run, tmp_path, name, value):
    assert run(out="one.exr")[0] == 0
    bitmap = mi.Bitmap(str(tmp_path / "one.exr"))
    bitmap.metadata()[f"manylights.{name}"] = json.dumps(value)
    bitmap.write(str(tmp_path / "one.exr"))
    status, log = run.merge(tmp_path / "one.exr")
    assert status == 2 and f"{tmp_path}/one.exr: not a whole part or image" in log


def test_images_of_other_renders_are_not_averaged(run, two, tmp_path):
    assert run(out="one.exr", seed=1)[0] == 0
    assert run("--set", "shadow_rays=2", out="two.exr", seed=2)[0] == 0
    status, log = run.merge(tmp_path / "one.exr", tmp_path / "two.exr")
    assert status == 2 and "not in the seed alone. It has set shadow_rays=2 and not none" in log
    for files in ((tmp_path / "one.exr", two[0]), (two[0], tmp_path / "one.exr")):
        assert "merge all parts of a render first" in run.merge(*files)[1]


def test_other_processors_are_told(run, parts, monkeypatch, tmp_path):
    assert run("--part", "1/2")[0] == 0
    monkeypatch.setattr("manylights.rendering.checkpoint.processor", lambda: "Abacus 9")
    assert run("--part", "2/2")[0] == 0
    status, log = run.merge(*tmp_path.glob("a.part-*.exr"))
    assert status == 0 and "processors: rendered on 2 types" in log and "Abacus 9" in log


def many_shapes():
    """Return a scene of which Mitsuba makes six meshes, in an order by chance."""
    scene = {"type": "scene", "sensor": {"type": "perspective"}}
    scene["integrator"] = {"type": "manylights_direct"}
    for group in range(6):
        grey = {"type": "rgb", "value": 0.1 + 0.1 * group}
        bsdf = {"type": "diffuse", "reflectance": grey}
        for index in range(40):
            place = mi.ScalarTransform4f().translate([group, index, 0])
            scene[f"floor_{group}_{index}"] = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
        scene[f"ball_{group}"] = {"type": "sphere", "bsdf": bsdf}
        scene[f"lamp_{group}"] = {"type": "sphere", "emitter": {"type": "area", "radiance": grey}}
    return scene


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_same_dictionary_is_the_same_scene(variant):
    require_variant(variant)

    def digest(scene):
        return job._digest(loading.as_loaded(scene)[0].scene)

    first = digest(many_shapes())
    assert all(digest(many_shapes()) == first for _ in range(7))
    for name, other, part in [
        ("lamp_0", "lamp_1", "emitter"),
        ("floor_0_0", "floor_1_0", "bsdf"),
        ("ball_0", "ball_1", "bsdf"),
    ]:
        scene = many_shapes()
        scene[name][part], scene[other][part] = scene[other][part], scene[name][part]
        assert digest(scene) != first

"""`manylights.render`: the same bits however a job is run, targets that are met, and its inputs."""

import time
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import cli, loading
from manylights.errors import UsageError
from manylights.loading import samplers
from manylights.rendering import Job, noise, plan
from manylights.rendering import develop as rendering
from manylights.rendering.sums import Sums

from tests import statistics_tools as tools
from tests.conftest import require_variant

SCENES = Path(__file__).parent.parent / "scenes"

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]


@pytest.fixture
def short_steps(monkeypatch):
    """Also small images are rendered in many steps: of 4096 samples at most."""
    monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", 0)
    monkeypatch.setattr(plan, "MOST_SAMPLES", dict.fromkeys(plan.MOST_SAMPLES, 2**12))


def loaded(name="many_bulbs", width=40, height=24, sampler=None, filter_type="gaussian"):
    """A scene of the folder with the default film's filter, which is wider than a pixel."""
    path = SCENES / f"{name}.xml"
    defines = {"resx": str(width), "resy": str(height)}
    with loading.search_beside(str(path)):
        parsed = loading.parse(str(path), defines)
        for node in parsed.state.nodes:
            if node.type == mi.ObjectType.ReconstructionFilter:
                node.props = mi.Properties(filter_type)
        samplers.choose(parsed.state, sampler)
        scene = loading.instantiate(parsed)
    return loading.LoadedScene(scene, 1, [])


# ---------------------------------------------------------------------------------- the same bits


@pytest.mark.parametrize("variant", VARIANTS)
def test_threads_do_not_change_the_bits(short_steps, variant):
    require_variant(variant)
    scene = loaded()
    one, two, three = (
        manylights.render(scene, spp=13, seed=3, threads=threads).image.tobytes()
        for threads in (1, 2, 3)
    )
    assert one == two == three


@pytest.mark.parametrize("variant", VARIANTS)
def test_steps_of_several_processes_add_up_to_the_same_bits(short_steps, variant):
    """Each has its own scene; the second one gets what the first has learnt, and goes backwards."""
    require_variant(variant)
    whole = manylights.render(loaded(), spp=19, seed=5)
    first, second = (Job.of(loaded(), spp=19, seed=5) for _ in range(2))
    steps = list(plan.steps(19, first.course.limits))
    assert len(steps) == 5 and first.course.limits.learns
    sums = [Sums(), Sums()]

    def render(job, step, to):
        to.add(job.driver.render(step, job.seed_of(step), 19, lambda done: None))

    for step in steps[:3]:
        render(first, step, sums[0])
    learnt = first.driver.learnt()
    assert learnt.size
    second.driver.learn(learnt)
    for step in reversed(steps[3:]):
        render(second, step, sums[1])
    total = Sums()
    total.merge(sums[1], sums[0])
    image = rendering.develop(first.film, total.rounded)[0]
    assert image.tobytes() == whole.image.tobytes()


@pytest.mark.parametrize("variant", VARIANTS)
def test_short_renders_are_those_of_mitsuba(variant):
    require_variant(variant)
    scene = loaded()
    image = manylights.render(scene, spp=9, seed=2).image
    assert image.tobytes() == np.array(mi.render(scene.scene, spp=9, seed=2)).tobytes()


def test_steps_have_the_samples_of_one_render(short_steps, llvm):
    """Of a sampler with samples by index, whose pixels are then the same but for rounding."""
    scene = loaded("one_light")
    image = manylights.render(scene, spp=32).image
    np.testing.assert_allclose(image, np.array(mi.render(scene.scene, spp=32)), rtol=1e-4)


def test_integrators_of_mitsuba_have_the_samples_of_one_render(short_steps, llvm):
    scene = loaded()
    integrator = mi.load_dict({"type": "path"})
    image = manylights.render(scene, spp=32, integrator=integrator).image
    whole = np.array(mi.render(scene.scene, integrator=integrator, spp=32))
    np.testing.assert_allclose(image, whole, rtol=1e-4)


def test_other_samplers_have_a_sequence_for_each_step(llvm, monkeypatch):
    """Few steps, each a render of its own; a note says so."""
    monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", 0)
    scene = loaded("aov", sampler="keep", filter_type="box")
    result = manylights.render(scene, spp=18, seed=3)
    limits = Job.of(scene, spp=18).course.limits
    sizes = [step.spp for step in plan.steps(18, limits)]
    assert sizes == [4, 4, 4, 4, 2] and "no samples by index: 5 steps" in result.notes[-1]
    expected = 0.0
    for index, size in enumerate(sizes):
        mi.render(scene.scene, seed=plan.seed_of(3, index), spp=size)
        image = scene.scene.sensors()[0].film().bitmap()
        expected = expected + np.array(image) * size / 18
    np.testing.assert_allclose(np.array(result.bitmap), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_nested_integrators_have_new_samples_in_each_step(short_steps, variant):
    require_variant(variant)
    scene = loaded("aov")
    job = Job.of(scene, spp=16)
    first, second = list(plan.steps(16, job.course.limits))[:2]
    a, b = (job.driver.render(step, 0, 16, lambda done: None) for step in (first, second))
    job.driver.end()
    names = job.driver.channels()
    for name in ("R", "depth.T"):
        assert (a[..., names.index(name)] != b[..., names.index(name)]).mean() > 0.3


def test_scene_is_left_as_it_was(short_steps, llvm):
    scene = loaded()
    before = np.array(mi.render(scene.scene, spp=8))
    manylights.render(scene, spp=19, seed=5)
    assert np.array(mi.render(scene.scene, spp=8)).tobytes() == before.tobytes()


# ---------------------------------------------------------------------------------------- targets


@pytest.fixture
def fewer_pilots(monkeypatch):
    """Renders of small images begin with few samples."""
    monkeypatch.setattr(plan, "PILOT_SAMPLES", 2**13)


@pytest.fixture
def few_pilots(fewer_pilots, scalar):
    """The same in the scalar variant, which is fast there."""


def renders(scene, spp, seeds):
    """Renders of so many samples, from four sequences, with this process's share of the cores."""
    wanted = {"spp": spp, "until_noise": 1e-9, "threads": tools.THREADS}
    results = [manylights.render(scene, seed=seed, **wanted) for seed in seeds]
    assert all(result.samples == spp for result in results)
    return results


@pytest.mark.parametrize(
    ("variant", "name", "width", "height"),
    [
        ("scalar_rgb", "many_bulbs", 40, 24),
        ("scalar_rgb", "interior", 40, 24),
        ("llvm_ad_rgb", "points", 96, 64),
    ],
)
def test_noise_is_that_of_many_seeds(fewer_pilots, variant, name, width, height):
    require_variant(variant)
    results = renders(loaded(name, width, height), 32, range(16))
    images, noises = (np.array([getattr(r, x) for r in results]) for x in ("image", "noise"))
    mean = images.mean(axis=0)
    truth = noise.noise(mean, images.var(axis=0, ddof=1))
    assert np.all(np.abs(noises / truth - 1.0) < 0.2), (truth, noises)


def test_noise_of_parts_of_one_sequence_is_too_high(few_pilots):
    """Why independent sequences are needed, and what the test above would find."""
    scene = loaded("points")
    images = tools.render_seeds(scene.scene, spp=32)
    truth = noise.noise(images.mean(axis=0), images.var(axis=0, ddof=1))
    job = Job.of(scene, spp=32)
    parts = [
        job.driver.render(plan.Step.of([plan.Pass(first, 8)]), 0, 32, lambda done: None)
        for first in range(0, 32, 8)
    ]
    job.driver.end()
    colors = np.stack([part[..., :3] / part[..., 3:] for part in parts])
    weights = np.full(4, 0.25)
    wrong = noise.noise(colors.mean(axis=0), noise.variance_of_mean(colors, weights))
    assert wrong > 1.2 * truth, (wrong, truth)


def test_variance_is_that_of_the_image(fewer_pilots, llvm):
    """Its mean over the pixels, against half the squared differences of images of two seeds.

    Without the noisiest tenth of the pixels, whose few bright samples are most of the mean; those
    are seen in other images.
    """
    scene = loaded("points", 64, 40)
    results = renders(scene, 32, range(48))
    images = np.stack([result.image for result in results])
    assert results[0].variance.shape == images[0].shape
    others = [manylights.render(scene, spp=32, seed=seed).image for seed in range(100, 108)]
    spread = np.var(others, axis=0)
    chosen = spread <= np.quantile(spread, 0.9)
    expected = (np.square(images[0::2] - images[1::2]) / 2)[:, chosen].mean(axis=1)
    found = np.stack([result.variance for result in results])[:, chosen].mean(axis=1)
    assert tools.welch(found, expected).p > tools.SIGNIFICANCE
    for factor in (1.15, 1 / 1.15):
        assert tools.welch(factor * found, expected).p < tools.SIGNIFICANCE


@pytest.mark.parametrize(
    ("name", "asked"), [("many_bulbs", 0.03), ("interior", 0.1), ("fog", 0.07)]
)
def test_noise_asked_for_is_reached(few_pilots, name, asked):
    scene = loaded(name)
    for seed in range(2):
        result = manylights.render(scene, seed=seed, until_noise=asked)
        assert 0.75 * asked < result.noise < 1.15 * asked


def test_mean_of_renders_until_a_noise_has_no_bias(few_pilots):
    """How many samples there are depends on them; a bias of two percent would be found."""
    scene = loaded("points", 16, 10, filter_type="box")
    wanted = {"until_noise": 0.02, "threads": tools.THREADS}
    results = [manylights.render(scene, seed=s, **wanted) for s in range(100, 132)]
    assert len({result.samples for result in results}) > 1
    images = np.stack([result.image for result in results])
    reference = tools.render_seeds(scene.scene, spp=256, seeds=range(8))
    tools.assert_same_mean(images, reference)
    with pytest.raises(AssertionError):
        tools.assert_same_mean(images * 1.02, reference)


def test_target_out_of_reach_says_what_was_reached(few_pilots):
    result = manylights.render(loaded(), spp=17, until_noise=1e-4)
    assert result.samples == 16
    assert f"{result.noise:.3g} was reached and not 0.0001, with 16 samples" in result.notes[-1]
    single = manylights.render(loaded(), spp=1, until_noise=0.1)
    assert single.noise is None and "too few" in single.notes[-1]


def test_renders_without_a_target_do_not_know_their_noise(few_pilots):
    result = manylights.render(loaded(), spp=4)
    assert result.noise is None and result.variance is None and result.samples == 4


def test_time_is_kept(scalar):
    scene = loaded()
    manylights.render(scene, spp=8)
    start = time.perf_counter()
    result = manylights.render(scene, seconds=1.0)
    assert 0.7 < result.seconds < 1.5 and time.perf_counter() - start < 2.5
    assert result.samples > 16 and result.noise > 0.0
    assert manylights.render(scene, seconds=1e6, spp=8).samples == 8


@pytest.mark.parametrize("variant", VARIANTS)
def test_interrupted_targets_go_on_to_the_same_bits(monkeypatch, tmp_path, variant):
    """The same decisions: how many samples there are depends on the sums alone."""
    require_variant(variant)
    monkeypatch.setattr(plan, "PILOT_SAMPLES", 2**13)
    scene, target = loaded("interior"), 0.15
    whole = manylights.render(scene, until_noise=target)
    path = tmp_path / "state.exr"
    options = {"until_noise": target, "checkpoint": path, "checkpoint_seconds": 1e-9}
    for steps in (1, 2, 3):
        calls = []

        def stop(progress, calls=calls, steps=steps):
            calls.append(progress.samples)
            if len(set(calls)) > steps:
                raise InterruptedError

        with pytest.raises(InterruptedError):
            manylights.render(scene, progress=stop, **options)
        assert path.exists()
    result = manylights.render(scene, **options)
    assert result.image.tobytes() == whole.image.tobytes()
    assert (result.samples, result.noise) == (whole.samples, whole.noise)
    assert not path.exists()


def test_command_writes_the_noise_into_the_file(few_pilots, tmp_path, capsys):
    out = tmp_path / "out.exr"
    arguments = ["render", str(SCENES / "points.xml"), "-o", str(out), "--variant", "scalar_rgb"]
    arguments += ["-D", "resx=32", "-D", "resy=20", "--until-noise", "0.05", "--spp", "256"]
    assert cli.main(arguments) == 0
    noise_in_file = mi.Bitmap(str(out)).metadata()["manylights.noise"]
    assert 0.025 < noise_in_file < 0.075
    assert f"noise {noise_in_file:.3g}, wrote" in capsys.readouterr().err


# ----------------------------------------------------------------------------------------- inputs


def test_scenes_of_all_kinds_are_the_same(scalar):
    path = SCENES / "points.xml"
    by_path = manylights.render(path, spp=2)
    assert any("independent replaced by manylights_sobol" in note for note in by_path.notes)
    assert manylights.render(str(path), spp=2).image.tobytes() == by_path.image.tobytes()
    scene = loading.load(str(path))
    assert manylights.render(scene, spp=2).image.tobytes() == by_path.image.tobytes()
    assert manylights.render(scene.scene, spp=2).image.tobytes() == by_path.image.tobytes()


def test_dictionaries_are_rendered_with_our_integrator_and_sampler(scalar):
    description = {**mi.cornell_box()}
    result = manylights.render(description, spp=2)
    assert "path replaced by manylights_volpath" in " ".join(result.notes)
    assert "replaced by manylights_sobol" in " ".join(result.notes)
    kept = manylights.render(description, spp=2, integrator="keep")
    assert "path replaced" not in " ".join(kept.notes)
    assert result.image.shape == (256, 256, 3) and result.image.mean() > 0.0


def test_integrators_are_chosen_in_all_ways(scalar):
    path, scene = SCENES / "points.xml", loaded("points", sampler="keep", filter_type="box").scene
    for wanted in ("depth", {"type": "depth"}, mi.load_dict({"type": "depth"})):
        for source in (scene, path):
            image = manylights.render(source, spp=1, integrator=wanted).image
            assert image.max() > 1.0 and np.ptp(image, axis=2).max() == 0.0


def test_progress_is_told(short_steps, llvm, tmp_path):
    seen = []
    options = {"checkpoint": tmp_path / "state.exr", "checkpoint_seconds": 1e-9}
    result = manylights.render(loaded(), spp=16, progress=seen.append, **options)
    fractions = [progress.fraction for progress in seen]
    assert fractions[0] == 0.0 and fractions[-1] == 1.0 and fractions == sorted(fractions)
    assert seen[-1].samples == result.samples == 16
    assert "has 12 of 16 samples per pixel" in seen[-1].kept


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"spp": 0}, "spp 0: must be an integer from 1 to 4294967295"),
        ({"spp": "many"}, "spp 'many': must be an integer from 1 to 4294967295"),
        ({"spp": 16.0}, "spp 16.0: must be an integer"),
        ({"spp": True}, "spp True: must be an integer"),
        ({"seed": -1}, "seed -1: must be an integer from 0 to 4294967295"),
        ({"seed": 1.5}, "seed 1.5: must be an integer"),
        ({"seed": None}, "seed None: must be an integer"),
        ({"sensor": 1}, "sensor 1: must be an integer from 0 to 0"),
        ({"sensor": "main"}, "sensor 'main': must be an integer"),
        ({"until_noise": 0.0}, "until_noise 0.0: must be a number above 0"),
        ({"until_noise": float("nan")}, "until_noise nan"),
        ({"until_noise": "2 %"}, "until_noise '2 %': must be a number above 0"),
        ({"seconds": float("inf")}, "seconds inf"),
        ({"seconds": "10m"}, "seconds '10m': must be a number above 0"),
        ({"threads": 0}, "threads 0"),
        ({"threads": "all"}, "threads 'all': must be an integer from 1 to 4096"),
        ({"threads": 10**9}, "threads 1000000000: must be an integer from 1 to 4096"),
        ({"integrator": 3}, "integrator 3: must be a name"),
        ({"integrator": {"max_depth": 3}}, """integrator {'max_depth': 3}: must be a dictionary"""),
        ({"integrator": {"type": "independent"}}, "must be an integrator of Mitsuba or ours"),
        ({"exposure": "bright"}, "exposure 'bright': must be a number from -64 to 64"),
        ({"checkpoint": 3}, "checkpoint 3: must be a path"),
        ({"part": (1, 2), "learnt": 3}, "learnt 3: must be a path"),
        ({"progress": "bar"}, "progress 'bar': must be a function"),
        ({"client": "local:2"}, "client 'local:2': must be a synchronous distributed.Client"),
        ({"tev": 14158}, "tev 14158: must be a text, HOST:PORT"),
        ({"checkpoint": "state.png"}, "checkpoint state.png: it is an OpenEXR file"),
        ({"checkpoint": "no/state.exr"}, "checkpoint no/state.exr: there is no folder no"),
        ({"checkpoint": "state.exr", "checkpoint_seconds": 0}, "checkpoint_seconds 0"),
        ({"checkpoint": "state.exr", "checkpoint_seconds": "1"}, "checkpoint_seconds '1': must be"),
        ({"output": "image.png"}, "image.png"),
    ],
)
def test_bad_arguments_are_named(scalar, options, words):
    with pytest.raises(ValueError) as raised:
        manylights.render(loaded(), **options)
    assert words in str(raised.value)


def test_bad_scenes_are_named(scalar, tmp_path):
    with pytest.raises(UsageError, match=r"no\.xml: no such file"):
        manylights.render(tmp_path / "no.xml")
    with pytest.raises(UsageError, match="'': no such file"):
        manylights.render("")
    for scene, shown in ((3, "3"), (None, "None"), ([{}], r"\[\{\}\]")):
        what = "a path, a dictionary or an mi.Scene of the variant scalar_rgb"
        with pytest.raises(UsageError, match=f"scene {shown}: must be {what}$"):
            manylights.render(scene)
    with pytest.raises(UsageError, match="scene: a dictionary of the type 'sphere', must be"):
        manylights.render({"type": "sphere"})
    with pytest.raises(UsageError, match=r"^aovs 3: must be a text with commas"):
        manylights.render(mi.cornell_box(), aovs=3)


def test_values_in_messages_are_short(scalar):
    with pytest.raises(UsageError) as raised:
        manylights.render([mi.cornell_box()])
    assert len(str(raised.value)) < 200 and "\n" not in str(raised.value)


def test_paths_in_messages_are_whole(scalar, tmp_path, capsys):
    path = tmp_path / ("long" * 30) / "a.exr"
    for learnt in (path, str(path)):
        with pytest.raises(UsageError) as raised:
            manylights.render(loaded(), learnt=learnt)
        assert str(raised.value) == f"learnt '{path}': must be given with part"
    command = ["render", "", "-o", str(tmp_path / "o.exr"), "--variant", "scalar_rgb"]
    assert cli.main(command) == 2
    assert "manylights: '': no such file" in capsys.readouterr().err


def test_scenes_without_an_integrator_need_one(scalar):
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "lamp": {"type": "constant"}}
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": 4, "height": 4}
    made = mi.load_dict(scene)
    for arguments in ((made, None), (made, "keep"), (scene, "keep")):
        with pytest.raises(UsageError, match=r'has no integrator, name one \(integrator="NAME"'):
            manylights.render(arguments[0], spp=1, integrator=arguments[1])
    assert manylights.render(made, spp=1, integrator="path").image.mean() == 1.0
    assert manylights.render(scene, spp=1).image.mean() == 1.0


def test_numbers_of_numpy_are_those_of_python(scalar, tmp_path):
    scene = loaded("points", 8, 6)
    plain = manylights.render(scene, spp=2, seed=3, output=tmp_path / "plain.exr")
    numbers = {"spp": np.int64(2), "seed": np.uint32(3), "sensor": np.int8(0)}
    same = manylights.render(scene, **numbers, threads=np.int64(2), output=tmp_path / "same.exr")
    assert same.image.tobytes() == plain.image.tobytes()
    noise = {"until_noise": np.float32(9.0), "seed": 3}
    assert manylights.render(scene, **noise, output=tmp_path / "noise.exr").noise < 9.0


def test_without_a_variant_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setattr(mi, "variant", lambda: None)
    calls = (
        lambda: manylights.render("scene.xml"),
        lambda: manylights.merge(["a.exr"]),
        lambda: manylights.mix("a.exr", {}, "b.exr"),
        lambda: manylights.merge_emitters({}),
        lambda: manylights.power_weights(None),
    )
    for call in calls:
        with pytest.raises(RuntimeError, match=r'call mitsuba\.set_variant\("llvm_ad_rgb"\)'):
            call()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--until-noise", v) for v in ("0", "-1", "nan", "inf", "little")]
    + [("--for", v) for v in ("0", "-1m", "nan", "10d", "m", "soon")],
)
def test_bad_targets_are_named(capsys, option, value):
    with pytest.raises(SystemExit) as raised:
        cli.main(["render", "scene.xml", "-o", "out.exr", f"{option}={value}"])
    assert raised.value.code == 2
    message = capsys.readouterr().err
    assert option in message and value in message


@pytest.mark.parametrize(("text", "seconds"), [("60", 60), ("60s", 60), ("1.5m", 90), ("2h", 7200)])
def test_times_have_units(text, seconds):
    assert cli.options.duration(text) == seconds


# --------------------------------------------------------------------------------------- samplers


SENSOR = '<sensor type="perspective"><film type="hdrfilm"/>{}</sensor>'


def chosen(tmp_path, text, wanted=None):
    """Choose the samplers of XML; returns the plugin's name, its parameters, and the log."""
    mi.set_variant("scalar_rgb")
    path = tmp_path / "chosen.xml"
    path.write_text(f'<scene version="3.0.0">{SENSOR.format(text)}</scene>')
    parsed = loading.parse(str(path))
    notes = samplers.choose(parsed.state, wanted)
    nodes = (node for node in parsed.state.nodes if node.type == mi.ObjectType.Sampler)
    found = [(node.props.plugin_name(), dict(node.props.items())) for node in nodes]
    with loading.search_beside(str(path)):
        loading.instantiate(parsed)
    return (*found[0], notes)


def sampler(kind):
    """A sampler as XML."""
    return f'<sampler type="{kind}"><integer name="sample_count" value="16"/></sampler>'


def test_independent_is_replaced_with_its_count(tmp_path):
    name, parameters, notes = chosen(tmp_path, sampler("independent"))
    assert (name, parameters) == ("manylights_sobol", {"sample_count": 16})
    undone = "(an mi.Scene keeps its own)"
    assert notes == [f"sampler: independent replaced by manylights_sobol {undone}"]


def test_sensor_without_sampler_gets_ours(tmp_path):
    assert chosen(tmp_path, "")[0] == "manylights_sobol"


@pytest.mark.parametrize("kind", ["multijitter", "stratified", "manylights_sobol"])
def test_other_samplers_stay(tmp_path, kind):
    assert chosen(tmp_path, sampler(kind)) == (kind, {"sample_count": 16}, [])


def test_samplers_can_be_kept_or_named(tmp_path):
    assert chosen(tmp_path, sampler("independent"), "keep")[::2] == ("independent", [])
    jittered = sampler("multijitter").replace("</s", '<boolean name="jitter" value="false"/></s')
    name, parameters, notes = chosen(tmp_path, jittered, "independent")
    assert (name, parameters) == ("independent", {"sample_count": 16})
    assert notes == ["sampler: multijitter replaced by independent"]


def test_an_image_that_was_stopped_is_none(tmp_path):
    """Mitsuba ends a render early after an interrupt, also where Python ignores that."""
    require_variant("scalar_rgb")
    scene = mi.load_dict(manylights.scenes.behind_wall(12, width=64, height=48))
    path = tmp_path / "a.exr"

    def stop(progress):
        if progress.fraction > 0.0:
            scene.integrator().cancel()

    with pytest.raises(UsageError, match="stopped before its end"):
        manylights.render(scene, spp=64, output=path, progress=stop)
    assert not path.exists()
    assert manylights.render(scene, spp=1, output=path).samples == 1

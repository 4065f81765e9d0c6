"""The report: what it reads, its statistics, and the page as a browser shows it."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from manylights.bench import metrics, records
from manylights.errors import UsageError
from manylights.report import (
    charts,
    grouping,
    markdown,
    page,
    pictures,
    sheets,
    statistics,
    tables,
)
from manylights.report.text import number

from tests import browser, report_data
from tests.command_line import assert_fails, manylights


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results and their report, as the command writes it."""
    path = tmp_path_factory.mktemp("results")
    report_data.write_results(path)
    process = manylights("report", path)
    assert process.returncode == 0, process.stderr
    return path


@pytest.fixture(scope="module")
def text(folder):
    return (folder / "report.html").read_text()


@pytest.fixture
def data(folder):
    return records.load(folder)


@pytest.fixture
def small(tmp_path):
    """A function that writes results with one scene of three methods, after changes to it."""

    def write(change=lambda data: None, **scene):
        specs = ("uniform", "talk", "resampled_tree")
        scenes = [report_data.make_scene("room", "Room", specs, **scene)]
        data = report_data.write_results(tmp_path, scenes)
        change(data)
        (tmp_path / "results.json").write_text(json.dumps(data))
        return tmp_path

    return write


@pytest.fixture
def undrawn(monkeypatch):
    """Leaves the charts empty, for tests of the text: drawing takes most of the time."""

    def save(name, figure, folder):
        (folder / f"{name}.svg").touch()
        return b""

    monkeypatch.setattr(charts, "save", save)
    monkeypatch.setattr(sheets, "save", save)


@pytest.fixture
def draw_only(monkeypatch):
    """A function that leaves all charts empty but those whose names begin in this way."""
    save = charts.save

    def choose(start):
        def save_some(name, figure, folder):
            return save(name, figure, folder) if name.startswith(start) else b""

        monkeypatch.setattr(charts, "save", save_some)
        monkeypatch.setattr(sheets, "save", save_some)

    return choose


# --- Statistics -------------------------------------------------------------------------------


def test_intervals_hold_the_mean_as_often_as_they_say():
    random = np.random.default_rng(3)
    trials, held = 2000, 0
    for values in random.gamma(25.0, 1 / 25.0, (trials, 5)):
        interval = statistics.log_mean_of(values).exp_interval()
        held += interval.low <= 1 <= interval.high
    # Five standard deviations of a binomial count
    assert abs(held / trials - 0.95) < 5 * np.sqrt(0.95 * 0.05 / trials)


def test_interval_of_a_mean_is_student_s():
    interval = statistics.mean_of(np.array([1.0, 2.0, 3.0])).interval()
    # The quantile of two degrees of freedom is 4.303.
    assert interval.value == 2
    assert interval.high == pytest.approx(2 + 4.30265 / np.sqrt(3), rel=1e-5)


def test_one_seed_has_no_interval():
    interval = statistics.log_mean_of(np.array([2.0])).exp_interval()
    assert interval.value == pytest.approx(2) and not interval.known


def series_of(points, method="talk", **parameters):
    """A series from (samples, seconds, error) with one mean of 1 for each of three seeds."""
    made = []
    for spp, seconds, error in points:
        spread = np.array([0.99, 1.0, 1.01])
        errors = error * spread
        made.append(records.Point(spp, seconds * np.ones(3), np.ones(3), errors, errors, spread))
    return records.Series(method, method, parameters, None, 0.0, 0.0, None, made)


def scene_of(*series, error=0.0, mean=1.0, mean_error=0.0):
    reference = {"error": error, "mean": mean, "mean_error": mean_error}
    fields = {field.name: None for field in dataclasses.fields(records.Scene)}
    fields.update(reference=reference, series=list(series), width=10, height=10, lights=1)
    return records.Scene(**fields)


def test_gain_is_the_ratio_of_error_times_time():
    ours, peer = series_of([(4, 1.0, 0.1)]), series_of([(4, 2.0, 0.3)])
    ratio = statistics.gain(peer, ours, scene_of(ours, peer))
    assert ratio.value == pytest.approx(6)
    assert ratio.low < 6 < ratio.high < 7


def test_gain_compares_errors_after_the_same_time():
    """A series that falls faster than 1 / time gains nothing by having been measured for longer."""
    peer = series_of([(1, 1.0, 1.0), (4, 4.0, 0.125), (16, 16.0, 0.125**2)])
    for seconds in (1.0, 2.0, 4.0, 10.0, 16.0):
        ours = series_of([(9, seconds, 0.1)])
        ratio = statistics.gain(peer, ours, scene_of(ours, peer))
        assert ratio.value == pytest.approx(seconds**-1.5 / 0.1)
        assert ratio.low < ratio.value < ratio.high
    for seconds, error in ((0.5, 2.0), (32.0, 0.125**2 / 2)):
        ours = series_of([(9, seconds, 0.1)])
        ratio = statistics.gain(peer, ours, scene_of(ours, peer))
        assert ratio.value == pytest.approx(error / 0.1)


def test_what_does_not_grow_with_the_samples_does_not_count():
    """Longer renders would have the same ratio."""
    ours = series_of([(1, 1.5, 1.0), (4, 3.0, 0.25)])
    for preparation in (0.0, 0.5, 20.0):
        peer = series_of([(spp, preparation + 0.1 * spp, 8 / spp) for spp in (16, 32)])
        ratio = statistics.gain(peer, ours, scene_of(ours, peer))
        assert ratio.value == pytest.approx(8 * 0.1 / 0.5)


@pytest.mark.parametrize("seconds", [(10.0, 10.1), (10.0, 9.0)])
def test_samples_are_never_free(seconds):
    """Where noise is all that grows, a sample takes a tenth of its share."""
    peer = series_of([(16, seconds[0], 1.0), (32, seconds[1], 0.5)])
    found = statistics.sample_seconds(peer).exp_interval().value
    assert found == pytest.approx(0.1 * seconds[1] / 32)
    assert statistics.is_mostly_preparation(peer)
    assert not statistics.is_mostly_preparation(series_of([(16, 1.0, 1.0), (32, 1.5, 0.5)]))


def test_times_of_samples_have_intervals():
    series = series_of([(1, 1.5, 1.0), (4, 3.0, 0.25)])
    series.points[1].seconds[:] = [2.7, 3.0, 3.3]
    slopes = np.array([1.2, 1.5, 1.8]) / 3
    found = statistics.sample_seconds(series)
    assert found.exp_interval().value == pytest.approx(slopes.mean())
    assert found.variance == pytest.approx(slopes.var(ddof=1) / 3 / slopes.mean() ** 2)


def test_points_at_the_error_of_the_reference_are_not_used():
    series = series_of([(1, 1.0, 1.0), (4, 4.0, 0.25), (16, 16.0, 0.11)])
    scene = scene_of(series, error=0.02)
    assert [statistics.is_limited(point, scene) for point in series.points] == [False, False, True]
    assert statistics.last_clear_point(series, scene).spp == 4
    assert statistics.time_to_reach(0.11, series, scene).measured is False


@pytest.mark.parametrize(
    ("target", "seconds", "measured"),
    [(0.5, 2.0, True), (0.25, 4.0, True), (0.05, 20.0, False), (2.0, 0.5, False)],
)
def test_time_to_reach_an_error(target, seconds, measured):
    series = series_of([(1, 1.0, 1.0), (4, 4.0, 0.25), (8, 8.0, 0.125)])
    reach = statistics.time_to_reach(target, series, scene_of(series))
    assert reach.seconds.value == pytest.approx(seconds)
    assert reach.seconds.low < seconds < reach.seconds.high
    assert reach.measured is measured


def test_errors_far_from_the_measured_ones_are_not_guessed():
    series = series_of([(1, 1.0, 1.0), (4, 4.0, 0.25)])
    assert statistics.time_to_reach(0.01, series, scene_of(series)) is None


@pytest.mark.parametrize(("mean", "found"), [(1.0, False), (0.9, True)])
def test_bias_of_a_tenth_is_found(mean, found):
    series = series_of([(1, 1.0, 1.0)])
    interval = statistics.bias(series, scene_of(series, mean=mean, mean_error=0.001))
    assert (interval.low > 0 or interval.high < 0) is found


def test_the_error_of_the_reference_counts_as_well():
    series = series_of([(1, 1.0, 1.0)])
    interval = statistics.bias(series, scene_of(series, mean=0.9, mean_error=0.1))
    assert interval.low < 0 < interval.high


# --- Grouping ---------------------------------------------------------------------------------


def test_of_a_sweep_the_default_and_a_peer_s_best_are_shown(data):
    scene = next(scene for scene in data.scenes if scene.name == "city_10000")
    shown = [series.spec for series in grouping.shown(scene)]
    best = grouping.best([one for one in scene.series if one.method == "talk"], scene).spec
    assert shown[0] == "resampled_tree" and sum("resampled_tree" in spec for spec in shown) == 1
    assert [spec for spec in shown if "talk" in spec] == list(dict.fromkeys(["talk", best]))


def test_sweeps_have_the_default_value(data):
    scene = next(scene for scene in data.scenes if scene.name == "city_10000")
    groups = grouping.sweeps(scene, "shadow_rays")
    assert [[value for value, _ in group] for group in groups] == [[1, 8, 16]]
    rates = {group[0][1].method: group for group in grouping.sweeps(scene, "splitting_rate")}
    assert [value for value, _ in rates["resampled_tree"]] == [0, 1, 2, 4]
    assert [value for value, _ in rates["talk"]] == [1, 2, 4, 8]


def test_sweeps_may_reach_infinity():
    rates = (0.0, 2.0, "inf")
    series = [series_of([(1, 1.0, 1.0)], "tree", splitting_rate=rate) for rate in rates]
    (group,) = grouping.sweeps(scene_of(*series[::-1]), "splitting_rate")
    assert [value for value, _ in group] == list(rates)


def test_the_default_by_name_is_the_default():
    """Sweeps measure it once more; charts have it once."""
    points = [(1, 1.0, 1.0)]
    plain, better = series_of(points), [(1, 0.9, 1.0)]
    named = series_of(better, shadow_rays=16)
    others = [series_of(points, shadow_rays=count) for count in (1, 8)]
    scene = scene_of(plain, named, *others)
    assert grouping.shown(scene) == [plain]
    (group,) = grouping.sweeps(scene, "shadow_rays")
    assert group == [(1, others[0]), (8, others[1]), (16, named)]


def test_a_family_is_ordered_by_lights(data):
    (family,) = grouping.families(data).values()
    assert [scene.lights for scene in family] == [100, 10_000]


def test_losses_are_those_of_the_slow_scene(data):
    losses = [row for row in tables.efficiencies(data, every=True) if row.lost]
    assert {row.scene.name for row in losses} == {"glossy"}
    assert {row.verdict for row in losses} == {"peer"}


# --- Pictures ---------------------------------------------------------------------------------


def test_deterministic_splitting_has_the_step(data):
    scene = next(scene for scene in data.scenes if scene.boundary)
    steps = {
        series.method: pictures.largest_step(line)
        for series, line in pictures.deviation_lines(scene, scene.series, [])
    }
    assert steps.pop("adaptive_splitting") == pytest.approx(3, rel=1e-3)
    assert max(steps.values()) < 1.1


def test_relative_error_is_that_of_bench():
    reference = np.full((2, 2, 3), 0.5)
    image = reference + np.array([0.1, 0.0, -0.2])
    expected = (0.01 + 0.04) / 3 / (0.25 + (0.05 * 0.5) ** 2)
    error = metrics.relative_errors(image, reference, 0.05)
    np.testing.assert_allclose(error, expected)


# --- Files and page ---------------------------------------------------------------------------


def test_charts_have_stable_names(folder):
    names = {path.name for path in (folder / "charts").iterdir()}
    stems = [
        "overview",
        "lights_city",
        "reach_0.1",
        "boundary_step",
        "error_time_glossy",
        "pictures_works",
    ]
    stems += [f"sweep_{name}_city_10000" for name in grouping.SWEPT]
    for stem in stems:
        assert {f"{stem}.svg", f"{stem}.png"} <= names


def test_denoised_images_have_a_chart(tmp_path, draw_only):
    draw_only("denoised")
    data = report_data.write_results(tmp_path, report_data.all_scenes()[:1])
    scene = data["scenes"][0]
    for series in scene["series"]:
        if series["spec"] in ("resampled_tree", "power"):
            series["denoised"] = json.loads(json.dumps(series["points"]))
            for point in series["denoised"]:
                point["seconds"] = [2 * seconds for seconds in point["seconds"]]
                point["error_trimmed"] = [0.1 * error for error in point["error_trimmed"]]
    (tmp_path / "results.json").write_text(json.dumps(data))
    found = records.load(tmp_path)
    drawn = charts.draw_all(found, {}, tmp_path / "charts")["denoised"]
    assert [chart.name for chart in drawn] == [f"denoised_{scene['name']}"]
    last = next(series for series in found.scenes[0].series if series.ours).denoised[-1]
    assert f"{last.error_trimmed.mean():.2g} in {last.seconds.mean():.2g} s" in drawn[0].alt
    text, _ = page.render(found, publish=False)
    assert '<section id="denoised">' in text


def test_readme_has_the_tables(folder):
    """Beside the results, with the charts that there are, and without what is private."""
    readme = (folder / "README.md").read_text()
    charts = re.findall(r"!\[[^\]]+\]\((\S+)\)", readme)
    assert charts == ["charts/overview.svg", "charts/lights_city.svg", "charts/boundary_step.svg"]
    assert all((folder / chart).is_file() for chart in charts)
    assert "private/works.xml" not in readme
    data = records.load(folder)
    for scene in data.scenes:
        (row,) = re.findall(rf"^\| {re.escape(scene.title)} \| [\d,]+ \| .*, .* \|$", readme, re.M)
        gains = dict(zip(readme_methods(readme), row.strip("| ").split(" | ")[3:]))
        for peer in grouping.one_a_method(scene)[1:]:
            ratio = statistics.gain(peer, grouping.ours(scene), scene)
            assert gains[peer.method] == number(ratio.value)


def readme_methods(readme):
    """The methods in the heading of the first table."""
    return re.findall(r"`(\w+)`", next(line for line in readme.splitlines() if "| scene" in line))


def test_readme_of_the_repository_is_what_the_command_writes():
    """Nobody has edited it, and nobody has forgotten to write it again."""
    committed = Path(__file__).parents[1] / "scenes" / "bench"
    text = markdown.render(records.load(committed), committed / "charts")
    assert (committed / "README.md").read_text() == text
    assert "](more.md)" in text


def test_a_readme_by_hand_stays(small, undrawn):
    path = small()
    (path / "README.md").write_text("Measured on a rainy day.\n")
    _, remarks = page.write_report(path, None, publish=False)
    assert any("README.md: not written by this command" in remark for remark in remarks)
    assert (path / "README.md").read_text() == "Measured on a rainy day.\n"
    (path / "README.md").unlink()
    for _ in range(2):
        _, remarks = page.write_report(path, None, publish=False)
        assert not any("README.md" in remark for remark in remarks)
    assert (path / "README.md").read_text().startswith("# Measurements")


def test_readme_of_few_results(small, undrawn):
    """One scene of one method, and no scene."""

    def one(data):
        data["scenes"][0]["series"] = data["scenes"][0]["series"][2:]

    for change in (one, lambda data: data["scenes"].clear()):
        data = records.load(small(change))
        text = markdown.render(data, data.folder / "charts")
        assert text.startswith("# Measurements") and "Time to the same error" not in text
        for scene in list(data.folder.glob("room")):
            shutil.rmtree(scene)


def test_page_needs_no_other_file(text):
    addresses = re.findall(r"""(?:src|href|action|data)=["']([^"']*)""", text)
    assert len(addresses) > 50
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert "url(" not in text and "@import" not in text and "<script" not in text


def test_page_says_how_it_was_measured(text):
    for words in ("llvm_ad_rgb", "Processor of the tests", "mitsuba 3.9.1", "0.05", "0.1 %"):
        assert words in text
    assert "5 renders with different seeds" in text and "Student" in text


def test_links_lead_to_sections(text):
    links = set(re.findall(r'href="#([^"]*)"', text))
    assert links == set(re.findall(r'<section id="([^"]*)"', text))


def test_losses_are_on_the_page(text):
    losses = text.partition('<section id="losses">')[2].partition("</section>")[0]
    assert "Glossy metal" in losses and "City" not in losses


def test_without_losses_the_page_says_so(small, undrawn):
    text, _ = page.render(records.load(small()), publish=False)
    assert "In none of 2 comparisons" in text


def test_private_pictures_stay_out_of_what_is_published(small, undrawn):
    data = records.load(small(private=True, source="secret/room.xml"))
    text, _ = page.render(data, publish=False)
    sheet = data.folder / "charts" / "pictures_room.svg"
    assert sheet.exists()
    assert "must not be passed on" in text and "secret/room.xml" in text and "<h3>Room" in text
    text, remarks = page.render(data, publish=True)
    assert remarks == ["room: private, its pictures are left out"]
    assert "must not be passed on" not in text and not sheet.exists()
    assert "secret" not in text and "<h3>Room" not in text and "data:image/png" not in text


def test_private_scenes_need_no_pictures_to_be_published(small, undrawn):
    path = small(private=True)
    for image in (path / "room").iterdir():
        image.unlink()
    text, _ = page.render(records.load(path), publish=True)
    assert '<th scope="row">Room</th>' in text


def test_titles_are_escaped(small, undrawn):
    def change(data):
        data["scenes"][0]["title"] = "<b>A & B</b>"

    text, _ = page.render(records.load(small(change)), publish=False)
    assert "&lt;b&gt;A &amp; B&lt;/b&gt;" in text and "<b>A &" not in text


@pytest.mark.parametrize("seeds", [1, 2])
def test_few_seeds(small, seeds):
    def change(data):
        for point in (p for series in data["scenes"][0]["series"] for p in series["points"]):
            for name in ("seconds", "cpu_seconds", "error", "error_trimmed", "mean"):
                point[name] = point[name][:seeds]

    text, _ = page.render(records.load(small(change)), publish=False)
    assert ("one seed" in text) is (seeds == 1)


def test_only_one_method_and_one_point(small):
    def change(data):
        scene = data["scenes"][0]
        scene["series"] = scene["series"][:1]
        scene["series"][0].update(equal_time=None, points=scene["series"][0]["points"][:1])

    text, _ = page.render(records.load(small(change)), publish=False)
    assert "nothing to compare" in text


def test_an_interrupted_run_is_shown_as_far_as_it_came(small, undrawn):
    def change(data):
        (scene,) = data["scenes"]
        series = {entry["spec"]: entry for entry in scene["series"]}
        series["uniform"].update(points=[], equal_time=None)
        for values in series["talk"]["points"][4].values():
            if isinstance(values, list):
                values.clear()
        data["scenes"].append({**scene, "name": "next", "reference": None, "series": []})

    data = records.load(small(change))
    assert [[series.spec for series in scene.series] for scene in data.scenes] == [
        ["talk", "resampled_tree"]
    ]
    assert [len(series.points) for series in data.scenes[0].series] == [4, 5]
    text, remarks = page.render(data, publish=False)
    assert [remark.split(":")[0] for remark in remarks] == ["room, uniform", "room, talk", "next"]
    assert "room, uniform: points not rendered yet" in text


def test_no_scenes(small):
    text, _ = page.render(records.load(small(lambda data: data["scenes"].clear())), publish=False)
    assert "0 scenes" in text


def test_missing_maps_are_left_out_with_a_remark(small, undrawn):
    path = small()
    (path / "room" / "talk.maps.exr").unlink()
    text, remarks = page.render(records.load(path), publish=False)
    assert any("talk.maps.exr" in remark for remark in remarks)
    assert "talk.maps.exr" in text and "resampled_tree.maps.exr" not in text


def test_maps_without_channels_are_told(small, undrawn):
    path = small()
    report_data.write_exr(path / "room" / "talk.maps.exr", np.ones((45, 80, 3)))
    _, remarks = page.render(records.load(path), publish=False)
    assert remarks == ["room/talk.maps.exr: has no channel candidates, node_visits"]


def test_missing_variance_is_left_out_with_a_remark(small, draw_only):
    draw_only("boundary")
    path = small(boundary=True)
    (path / "room" / "talk.variance.exr").unlink()
    _, remarks = page.render(records.load(path), publish=False)
    assert any("talk.variance.exr" in remark for remark in remarks)
    assert (path / "charts" / "boundary_room.svg").exists()


# --- Bad input --------------------------------------------------------------------------------


def test_folder_without_results(tmp_path):
    assert_fails(manylights("report", tmp_path), "results.json", "no such file")


def test_broken_json(tmp_path):
    (tmp_path / "results.json").write_text('{"format": 1,')
    assert_fails(manylights("report", tmp_path), "results.json", "not JSON")


def set_format(data):
    data["format"] = 2


def remove_seconds(data):
    del data["scenes"][0]["series"][1]["points"][2]["seconds"]


def shorten_errors(data):
    data["scenes"][0]["series"][1]["points"][2]["error"].pop()


def set_text(data):
    data["scenes"][0]["lights"] = "many"


def set_nan(data):
    data["scenes"][0]["reference"]["error"] = float("nan")


def leave_folder(data):
    data["scenes"][0]["name"] = "../other"


def set_negative(data):
    data["scenes"][0]["series"][0]["points"][0]["error_trimmed"][1] = -1.0


def repeat_scene(data):
    data["scenes"] *= 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_format, "format: 2 is unknown, this version reads 1"),
        (remove_seconds, r"scenes\[0\]\.series\[1\]\.points\[2\]\.seconds: missing"),
        (shorten_errors, r"points\[2\]\.error: 4 values for 5 seeds"),
        (set_text, r"scenes\[0\]\.lights: str instead of int"),
        (set_nan, "reference.error: nan is not a finite number"),
        (leave_folder, r"scenes\[0\]\.name: '../other' cannot be part of a file name"),
        (set_negative, r"points\[0\]\.error_trimmed: negative"),
        (repeat_scene, "room is there twice"),
    ],
)
def test_wrong_results_are_refused(small, change, words):
    path = small(change)
    with pytest.raises(UsageError, match=words) as raised:
        records.load(path)
    assert "results.json" in str(raised.value)


@pytest.mark.parametrize("name", ["reference.exr", "talk.exr"])
def test_missing_images_are_refused(small, name):
    path = small()
    (path / "room" / name).unlink()
    with pytest.raises(UsageError, match=f"{name}: no such file"):
        page.write_report(path, None, publish=False)
    assert not (path / "report.html").exists()


def test_broken_image_is_refused(small):
    path = small()
    (path / "room" / "talk.exr").write_bytes(b"no image")
    with pytest.raises(UsageError, match=r"talk\.exr: not a readable image"):
        page.render(records.load(path), publish=False)


def test_image_of_another_size_is_refused(small):
    path = small()
    report_data.write_exr(path / "room" / "talk.exr", np.ones((4, 6, 3)))
    with pytest.raises(UsageError, match=r"talk\.exr: 6 x 4 pixels instead of 80 x 45"):
        page.render(records.load(path), publish=False)


def test_page_that_cannot_be_written(folder, tmp_path):
    with pytest.raises(UsageError, match=r"page\.html: there is no folder"):
        page.write_report(folder, str(tmp_path / "no" / "page.html"), publish=False)


def test_importing_the_package_needs_none_of_it():
    names = "{'jinja2', 'matplotlib', 'scipy'}"
    code = "import sys; from manylights.cli.main import parser; parser()"
    code += f"; sys.exit(len({names} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


@pytest.mark.parametrize("name", ["jinja2", "matplotlib", "scipy"])
def test_missing_packages_are_named(tmp_path, name):
    code = f"import sys; sys.modules['{name}'] = None; from manylights.cli import main"
    code += "; sys.exit(main(['report', '.']))"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=tmp_path
    )
    assert_fails(process, name, "pip install 'manylights[bench]'")


# --- In a browser -----------------------------------------------------------------------------

needs_browser = pytest.mark.skipif(
    not browser.find(), reason="no Chromium (on Debian: apt install chromium)"
)


def assert_fine(findings):
    assert findings["console"] == []
    assert findings["broken"] == []
    assert findings["content"] <= findings["width"]
    assert findings["wide"] == []


@needs_browser
@pytest.mark.parametrize(("width", "dark"), [(380, False), (1200, True)])
def test_page_in_a_browser(folder, tmp_path, width, dark):
    findings = browser.look_at(folder / "report.html", tmp_path, width, dark)
    assert_fine(findings)
    assert findings["width"] == width
    assert findings["images"] > 50
    assert "Where it does not win" in findings["headings"]


@needs_browser
@pytest.mark.parametrize(
    ("defect", "finding"),
    [
        ('<img src="data:image/png;base64,AAAA" alt="broken">', "broken"),
        ('<img src="https://example.invalid/a.png" alt="away">', "console"),
        ('<p style="width: 500px">wide</p>', "wide"),
        ("<script>1</script>", "console"),
    ],
)
def test_defects_are_seen(folder, tmp_path, defect, finding):
    """The checks find what is wrong with a page, so that silence means something."""
    text = (folder / "report.html").read_text()
    (tmp_path / "page.html").write_text(text.replace("</main>", f"{defect}</main>"))
    findings = browser.look_at(tmp_path / "page.html", tmp_path)
    assert findings[finding]
    with pytest.raises(AssertionError):
        assert_fine(findings)


def test_numbers_alone_make_a_page(tmp_path, draw_only):
    """The published results of the standard scenes have no pictures; one chart has all scenes."""
    draw_only("overview")
    published = Path(__file__).parents[1] / "scenes" / "bench" / "results.json"
    (tmp_path / "results.json").write_bytes(published.read_bytes())
    written, remarks = page.write_report(str(tmp_path), None, publish=False)
    assert written.is_file()
    assert "city_1M: no folder, its pictures are left out" in remarks
    assert (tmp_path / "charts" / "overview.svg").is_file()

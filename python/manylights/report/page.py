"""Writes the page: all parts in one HTML file that needs no other and runs no script."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jinja2

from manylights import files
from manylights.bench import records
from manylights.bench.methods import ABOUT
from manylights.report import charts, grouping, markdown, pictures, sheets, statistics, tables
from manylights.report.text import number, percent, ratio

PAGE_NAME, CHART_FOLDER = "report.html", "charts"


@dataclass(frozen=True)
class Steps:
    """Largest step between neighbouring columns of a boundary scene."""

    scene: records.Scene
    label: str
    low: float
    high: float
    step: float


def write_report(folder: str, output: str | None, publish: bool) -> tuple[Path, list[str]]:
    """Write the page, the charts, and README.md beside the results.

    Args:
        folder: what ``manylights bench`` wrote.
        output: the page; None for report.html in ``folder``.
        publish: leave out pictures and file names of private scenes.

    Returns:
        The page's path, and remarks on what was left out or left as it is.
    """
    data = records.load(folder)
    target = files.check_output(output or str(data.folder / PAGE_NAME))
    files.check_apart(target, [data.folder / records.FILE])
    text, remarks = render(data, publish)
    with files.written_whole(target) as partial:
        partial.write_text(text, encoding="utf-8")
    remarks += markdown.write_readme(data, data.folder / CHART_FOLDER)
    return target, remarks


def render(data: records.Results, publish: bool) -> tuple[str, list[str]]:
    """Return the page's text and remarks; write the charts."""
    remarks = list(data.remarks)
    visible = _scene_pictures(data, publish, remarks)
    deviations = {
        scene: pictures.deviation_lines(scene, grouping.shown(scene), remarks)
        for scene in data.scenes
        if scene.boundary
    }
    folder = data.folder / CHART_FOLDER
    drawn = charts.draw_all(data, deviations, folder)
    sheets.write_sheets(visible, folder)
    if publish:
        sheets.remove_sheets([scene for scene in data.scenes if scene.private], folder)
    compared = tables.efficiencies(data, every=True)
    text = (
        _environment()
        .get_template("template.html")
        .render(
            results=data,
            publish=publish,
            remarks=remarks,
            charts=drawn,
            pictures=visible,
            summaries=tables.summaries(data),
            efficiencies=tables.efficiencies(data),
            losses=[row for row in compared if row.lost],
            compared=len(compared),
            biases=tables.biases(data),
            times=tables.times(data),
            steps=_steps(deviations),
            methods=_methods(data),
            seeds=_seeds(data),
            targets=charts.TARGETS,
            clearly_above=statistics.CLEARLY_ABOVE,
            private=any(scene.private for scene in data.scenes),
        )
    )
    return text, remarks


def _environment() -> jinja2.Environment:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters.update(
        number=number, ratio=ratio, percent=percent, svg=_svg_uri, count=lambda n: f"{n:,}"
    )
    return environment


def _scene_pictures(data, publish: bool, remarks: list[str]) -> list[pictures.ScenePictures]:
    found = []
    for scene in data.scenes:
        if scene.private and publish:
            remarks.append(f"{scene.name}: private, its pictures are left out")
            continue
        made = pictures.scene_pictures(scene, data.metric["epsilon"], remarks)
        if made:
            found.append(made)
    return found


def _steps(deviations: charts.Deviations) -> list[Steps]:
    return [
        Steps(scene, grouping.label(series), line.min(), line.max(), pictures.largest_step(line))
        for scene, lines in deviations.items()
        for series, line in lines
    ]


def _methods(data) -> dict[str, str]:
    """The measured methods in the order of charts, with what they do."""
    measured = {series.method for scene in data.scenes for series in scene.series}
    known = {method: about.meaning for method, about in ABOUT.items() if method in measured}
    return {**known, **{method: "" for method in sorted(measured - set(known))}}


def _seeds(data) -> str:
    """How many renders with different seeds a point has."""
    counts = {
        len(point.seconds)
        for scene in data.scenes
        for series in scene.series
        for point in series.points
    }
    ends = sorted({min(counts, default=0), max(counts, default=0)})
    return " to ".join(map(str, ends))


def _svg_uri(chart: charts.Chart) -> str:
    return pictures.data_uri("image/svg+xml", chart.svg)

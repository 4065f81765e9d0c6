"""Draws the pictures of a scene as one figure, for use outside of the page."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from manylights.report.charts import STYLE, save
from manylights.report.pictures import MapRow, Picture, ScenePictures
from manylights.report.results import Scene

#: Inches of a picture, and of the text under it.
WIDTH, TEXT_HEIGHT = 1.75, 0.75


def write_sheets(found: list[ScenePictures], folder: Path) -> None:
    """Write pictures_SCENE.svg and .png: crops at equal time, and maps under them."""
    with matplotlib.rc_context({**STYLE, "font.size": 8}):
        for pictures in found:
            save(_name(pictures.scene), _sheet(pictures), folder)


def remove_sheets(scenes: list[Scene], folder: Path) -> None:
    """Delete sheets of an earlier report, which may show what must not be published."""
    for scene in scenes:
        for ending in ("svg", "png"):
            (folder / f"{_name(scene)}.{ending}").unlink(missing_ok=True)


def _name(scene: Scene) -> str:
    return f"pictures_{scene.name}"


def _sheet(pictures: ScenePictures) -> Figure:
    # Each method has a column.
    labels = [crop.label for crop in pictures.crops]
    columns, rows = len(labels), 1 + len(pictures.maps)
    flat = WIDTH * pictures.scene.height / pictures.scene.width + TEXT_HEIGHT
    heights = [WIDTH + TEXT_HEIGHT, *[flat] * len(pictures.maps)]
    figure = Figure(figsize=(WIDTH * columns + 1, sum(heights) + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, height_ratios=heights)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, crop in zip(grid[0], pictures.crops):
        _show(axes, crop)
    for line, row in zip(grid[1:], pictures.maps):
        for picture in row.pictures:
            _show(line[labels.index(picture.label)], picture)
        figure.colorbar(_scale(row), ax=line, label=row.title, shrink=0.8, aspect=12)
    title = pictures.scene.title
    if pictures.scene.equal_time:
        title += f", {pictures.scene.equal_time:g} s each"
    figure.suptitle(title, fontsize=11)
    return figure


def _show(axes, picture: Picture) -> None:
    axes.imshow(picture.pixels, interpolation="none")
    axes.set_title(picture.label, fontsize=8)
    notes = "\n".join(picture.notes)
    axes.text(0.5, -0.04, notes, transform=axes.transAxes, ha="center", va="top")


def _scale(row: MapRow) -> ScalarMappable:
    norm = LogNorm if row.logarithmic else Normalize
    return ScalarMappable(norm(row.low, row.high), row.colors)

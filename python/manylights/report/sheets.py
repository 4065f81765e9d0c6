"""Draws the pictures of a scene as one figure, for use outside of the page."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from manylights.bench.records import Scene
from manylights.report.charts import STYLE, plain, save
from manylights.report.pictures import MapRow, Picture, ScenePictures

# All in inches: the width of a picture and the gap between two, what a line of text takes, the
# place of a colour scale with its numbers, and the margin.
WIDTH, GAP, LINE, SCALE, MARGIN = 1.75, 0.12, 0.15, 0.75, 0.12


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
    """Lay out by hand: matplotlib's own layout of so many axes takes seconds."""
    shape = pictures.scene.height / pictures.scene.width
    # Each method has a column.
    labels = [crop.label for crop in pictures.crops]
    rows = [(pictures.crops, WIDTH, None)]
    rows += [(row.pictures, WIDTH * shape, row) for row in pictures.maps]
    heights = [_text_lines(row) * LINE + height + GAP for row, height, _ in rows]
    width = len(labels) * (WIDTH + GAP) + SCALE + 2 * MARGIN
    top = sum(heights) + 2 * LINE + 2 * MARGIN
    figure = Figure(figsize=(width, top))

    def place(left, bottom, wide, high):
        return figure.add_axes([left / width, bottom / top, wide / width, high / top])

    _title(figure, pictures.scene)
    bottom = top - MARGIN - 2 * LINE
    for (row, height, scale), step in zip(rows, heights):
        low = bottom - 1.3 * LINE - height
        for picture in row:
            left = MARGIN + labels.index(picture.label) * (WIDTH + GAP)
            _show(place(left, low, WIDTH, height), picture)
        if scale:
            axes = place(MARGIN + len(labels) * (WIDTH + GAP), low, 0.1, height)
            figure.colorbar(_scale(scale), cax=axes, label=scale.title.replace(" per", "\nper"))
        bottom -= step
    return figure


def _text_lines(row: list[Picture]) -> float:
    """Lines of text above and under a row, with some space."""
    return max(len(picture.notes) for picture in row) + 2


def _title(figure: Figure, scene: Scene) -> None:
    title = scene.title + (f", {scene.equal_time:g} s each" if scene.equal_time else "")
    height = figure.get_figheight()
    figure.text(0.5, 1 - MARGIN / height, plain(title, 120), ha="center", va="top", fontsize=11)


def _show(axes, picture: Picture) -> None:
    axes.set_axis_off()
    axes.imshow(picture.pixels, interpolation="none", aspect="auto")
    axes.set_title(plain(picture.label, 28), fontsize=8, pad=3)
    axes.annotate(
        "\n".join(picture.notes),
        (0.5, 0),
        (0, -3),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        va="top",
    )


def _scale(row: MapRow) -> ScalarMappable:
    norm = LogNorm if row.logarithmic else Normalize
    return ScalarMappable(norm(row.low, row.high), row.colors)

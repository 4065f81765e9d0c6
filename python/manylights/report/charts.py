"""Draws the charts with matplotlib, without its global state, and writes them as PNG and SVG.

Each method has a colour and a marker of its own (``bench.methods.ABOUT``). Charts are five inches
wide so that their text is legible on a phone.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from manylights.bench.methods import ABOUT, SWEPT
from manylights.bench.records import Point, Results, Scene, Series
from manylights.loading.ours import value_text
from manylights.report import grouping
from manylights.report.statistics import (
    CLEARLY_ABOVE,
    Interval,
    cost,
    error_interval,
    is_limited,
    last_clear_point,
    log_mean_of,
    sample_nanoseconds,
    time_to_reach,
)

#: Colour and marker of a method that is not known.
OTHER_LOOK = ("#777777", "*")
#: Tells series of one method apart.
DASHES = ("-", "--", ":", "-.")

STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 11,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.5,
    "savefig.dpi": 160,
    # Letters become paths: every machine shows the same. The fixed salt makes files repeatable.
    "svg.fonttype": "path",
    "svg.hashsalt": "manylights",
}

#: Inches.
WIDTH, HEIGHT = 5.0, 4.3

#: Inches of a line of the legend.
LEGEND_ROW = 0.19

#: Letters, beyond which a legend has fewer columns.
LONG_LABEL = 30

#: Errors in the chart of the time that an error takes.
TARGETS = (1.0, 0.1, 0.01, 0.001)

ERROR = "relative MSE (trimmed)"
TIME = "time of the render (s)"


#: Standard deviation by column of some series of a scene.
Deviations = dict[Scene, list[tuple[Series, np.ndarray]]]


@dataclass(frozen=True)
class Chart:
    """One chart; the files are charts/NAME.svg and charts/NAME.png."""

    name: str
    alt: str
    svg: bytes


def draw_all(results: Results, deviations: Deviations, folder: Path) -> dict[str, list[Chart]]:
    """Draw all charts that there are data for, write them, and return them by kind."""
    folder.mkdir(exist_ok=True)
    kinds = {
        "overview": _overview,
        "error_time": _error_times,
        "denoised": _denoised,
        "reach": _reaches,
        "lights": _light_counts,
        "sweeps": _sweeps,
    }
    with matplotlib.rc_context(STYLE):
        drawn = {
            kind: [_save(*chart, folder) for chart in draw(results)] for kind, draw in kinds.items()
        }
        drawn["boundary"] = [_save(*chart, folder) for chart in _boundaries(deviations)]
    return drawn


def _save(name: str, title: str, alt: str, figure: Figure, folder: Path) -> Chart:
    if title:
        figure.suptitle(plain(title, 56), fontsize=11)
    return Chart(name, alt, save(name, figure, folder))


def save(name: str, figure: Figure, folder: Path) -> bytes:
    """Write a figure as SVG and PNG, and return the SVG."""
    svg = io.BytesIO()
    # Without the date the same measurements give the same bytes.
    figure.savefig(svg, format="svg", metadata={"Date": None})
    (folder / f"{name}.svg").write_bytes(svg.getvalue())
    # Placing everything takes most of the time, and the places are known now.
    figure.set_layout_engine("none")
    figure.savefig(folder / f"{name}.png")
    return svg.getvalue()


# --- Error against time -----------------------------------------------------------------------


def _overview(results: Results) -> Iterator[tuple]:
    scenes = [scene for scene in results.scenes if scene.series]
    if not scenes:
        return
    # Four are a square, not a row of three and one
    columns = 2 if len(scenes) == 4 else min(3, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure = Figure(figsize=(max(WIDTH, 3.4 * columns), 2.7 * rows + 0.8), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    handles, extra = {}, {}
    for axes, scene in zip(grid.flat, scenes):
        for series in grouping.one_a_method(scene):
            handles[series.method] = _error_line(axes, series, scene, "-", series.method)
        extra.update((line.get_label(), line) for line in _finish_error_time(axes, scene))
        if _some_limited(scene):
            extra["limited"] = _hollow("limited by the reference")
        axes.set_title(plain(scene.title, 36))
    for axes in grid.flat[len(scenes) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_ylabel(ERROR)
    for index in range(len(scenes)):
        if index + columns >= len(scenes):
            grid.flat[index].set_xlabel("time (s)")
    named = [handles[method] for method in _ordered(handles)]
    _legend(figure, [*named, *extra.values()], max(2, columns + 1))
    alt = f"Error against time in {len(scenes)} scenes, one line a method."
    # Each of the small charts has its title.
    yield "overview", "", alt, figure


def _error_times(results: Results) -> Iterator[tuple]:
    for scene in results.scenes:
        if scene.series:
            alt = f"Error against time in {scene.title}. Longest renders: {_ends(scene)}."
            yield f"error_time_{scene.name}", scene.title, alt, _error_time(scene)


def _ends(scene: Scene) -> str:
    """The last points of a chart in words."""
    texts = []
    for series in grouping.shown(scene):
        point = series.points[-1]
        seconds, error = point.seconds.mean(), point.error_trimmed.mean()
        texts.append(f"{grouping.label(series)} {error:.2g} in {seconds:.2g} s")
    return "; ".join(texts)


def _error_time(scene: Scene) -> Figure:
    figure, axes = _figure()
    handles, used = [], {}
    for series in grouping.shown(scene):
        dash = DASHES[used.get(series.method, 0) % len(DASHES)]
        used[series.method] = used.get(series.method, 0) + 1
        handles.append(_error_line(axes, series, scene, dash, grouping.label(series)))
    handles += _finish_error_time(axes, scene)
    axes.set(xlabel=TIME, ylabel=ERROR)
    if _some_limited(scene):
        handles.append(_hollow("limited by the reference"))
    _legend(figure, handles)
    return figure


def _some_limited(scene: Scene) -> bool:
    """Whether the chart of a scene has hollow markers."""
    shown = grouping.shown(scene)
    return any(is_limited(point, scene) for series in shown for point in series.points)


def _error_line(axes, series: Series, scene: Scene, dash: str, label: str) -> Line2D:
    """Draw one series with its band; return what the legend shows."""
    color, marker = _look(series.method)
    times = np.array([point.seconds.mean() for point in series.points])
    errors = [error_interval(point) for point in series.points]
    limited = np.array([is_limited(point, scene) for point in series.points])
    look = {"color": color, "marker": marker, "zorder": 4 if series.ours else 3}
    if series.ours:
        look["linewidth"] = 2.4
    values = np.array([error.value for error in errors])
    axes.plot(times, values, dash, **{**look, "marker": ""})
    for mask, face in ((~limited, color), (limited, "white")):
        axes.plot(times[mask], values[mask], **look, linestyle="", markerfacecolor=face)
    lows, highs = ([getattr(error, end) for error in errors] for end in ("low", "high"))
    axes.fill_between(times, lows, highs, color=color, alpha=0.2, linewidth=0, zorder=2)
    return Line2D([], [], linestyle=dash, label=label, **look)


def _denoised(results: Results) -> Iterator[tuple]:
    """Error against time of denoised images, and as thin lines of the same without denoising."""
    for scene in results.scenes:
        pairs = [series for series in grouping.one_a_method(scene) if series.denoised]
        if not pairs:
            continue
        figure, axes = _figure()
        handles = []
        for series in pairs:
            label, color = grouping.label(series), _look(series.method)[0]
            times = [point.seconds.mean() for point in series.points]
            errors = [error_interval(point).value for point in series.points]
            axes.plot(times, errors, color=color, linewidth=1.0, alpha=0.7, linestyle=":")
            clean = replace(series, points=series.denoised)
            handles.append(_error_line(axes, clean, scene, "-", label))
        points = [point for series in pairs for point in (*series.points, *series.denoised)]
        handles += _finish_error_time(axes, scene, points)
        handles.append(Line2D([], [], color="#555555", linewidth=1.0, linestyle=":", label="noisy"))
        if any(is_limited(point, scene) for series in pairs for point in series.denoised):
            handles.append(_hollow("limited by the reference"))
        axes.set(xlabel=TIME, ylabel=ERROR)
        _legend(figure, handles)
        alt = f"Error against time of denoised images in {scene.title}: {_denoised_ends(pairs)}."
        yield f"denoised_{scene.name}", f"{scene.title}, denoised", alt, figure


def _denoised_ends(pairs: list[Series]) -> str:
    """The longest renders of a chart in words."""
    texts = []
    for series in pairs:
        noisy, clean = series.points[-1].error_trimmed, series.denoised[-1].error_trimmed
        seconds = series.denoised[-1].seconds.mean()
        name = grouping.label(series)
        texts.append(f"{name} {clean.mean():.2g} in {seconds:.2g} s ({noisy.mean():.2g} noisy)")
    return "; ".join(texts)


def _finish_error_time(axes, scene: Scene, points: list[Point] | None = None) -> list[Line2D]:
    """Scale the axes and add the guide and the reference's error; return these for the legend.

    The points are those of the series that charts show, if no others are given.
    """
    axes.set(xscale="log", yscale="log")
    points = points or [point for series in grouping.shown(scene) for point in series.points]
    times = np.array([point.seconds.mean() for point in points])
    errors = np.array([point.error_trimmed.mean() for point in points])
    # Bands may reach far: limits follow the means, with a margin of a third of a decade.
    axes.set_xlim(times.min() / 1.3, times.max() * 1.3)
    axes.set_ylim(errors.min() / 2, errors.max() * 2)
    span = np.array([times.min(), times.max()])
    # Below all lines, where it hides none
    level = (errors * times).min() / 2.5
    style = {"color": "#999999", "linewidth": 1.0, "zorder": 1}
    guide = axes.plot(span, level / span, linestyle=(0, (6, 3)), label="slope -1", **style)
    own = scene.reference["error"]
    if own > errors.min() / (2 * CLEARLY_ABOVE):
        axes.set_ylim(bottom=min(own / 1.5, errors.min() / 2))
        style.update(linestyle=(0, (1, 2)), color="#555555")
        guide.append(axes.axhline(own, label="error of the reference", **style))
    _log_ticks(axes)
    return guide


# --- Time to reach an error -------------------------------------------------------------------


def _reaches(results: Results) -> Iterator[tuple]:
    for target in TARGETS:
        rows = []
        for scene in results.scenes:
            reached = {
                series.method: time_to_reach(target, series, scene)
                for series in grouping.one_a_method(scene)
            }
            reached = {method: reach for method, reach in reached.items() if reach}
            # With one method there is nothing to compare.
            if len(reached) > 1 and any(reach.measured for reach in reached.values()):
                rows.append((scene, reached))
        if rows:
            alt = f"Seconds until the error is {target:g}: " + "; ".join(map(_reach_text, rows))
            title = f"Time until the relative MSE is {target:g}"
            yield f"reach_{target:g}", title, alt, _reach(rows)


def _reach_text(row: tuple) -> str:
    scene, reached = row
    times = (f"{method} {reach.seconds.value:.2g}" for method, reach in reached.items())
    return f"{scene.title}: {', '.join(times)}"


def _reach(rows: list[tuple]) -> Figure:
    methods = _ordered({name for _, reached in rows for name in reached})
    figure, axes = _figure(1.6 + 0.5 * len(rows) + 0.1 * len(methods))
    handles = {}
    for row, (_, reached) in enumerate(rows):
        if row % 2:
            axes.axhspan(row - 0.5, row + 0.5, color="#f3f3f0", zorder=0)
        for method, reach in reached.items():
            # Markers of one scene are spread, so that none hides another.
            shift = (methods.index(method) + 0.5) / len(methods) - 0.5
            color, marker = _look(method)
            face = color if reach.measured else "white"
            time = reach.seconds
            look = {"color": color, "marker": marker, "linestyle": ""}
            if time.known:
                axes.plot([time.low, time.high], [row + 0.8 * shift] * 2, color=color, alpha=0.5)
            axes.plot(time.value, row + 0.8 * shift, markerfacecolor=face, zorder=3, **look)
            handles[method] = Line2D([], [], label=method, **look)
    axes.set_yticks(range(len(rows)), [scene.name for scene, _ in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(False, axis="y")
    axes.set(xscale="log", xlabel="time (s)")
    _log_ticks(axes, "x")
    extra = [_hollow("continued with slope -1")]
    if all(reach.measured for _, reached in rows for reach in reached.values()):
        extra = []
    _legend(figure, [handles[method] for method in methods] + extra)
    return figure


# --- Number of lights -------------------------------------------------------------------------


def _light_counts(results: Results) -> Iterator[tuple]:
    for family, scenes in grouping.families(results).items():
        counts = ", ".join(f"{scene.lights:,}" for scene in scenes)
        alt = f"Error, time of a sample and build time against the number of lights: {counts}."
        yield f"lights_{family}", f"Scenes “{family}”", alt, _lights(scenes)


def _lights(scenes: list[Scene]) -> Figure:
    chosen = {scene: grouping.as_they_come(scene) for scene in scenes}
    methods = _ordered({series.method for group in chosen.values() for series in group})
    builds = any(series.build_seconds > 0 for group in chosen.values() for series in group)
    figure = Figure(figsize=(WIDTH, 7.6 if builds else 5.6), layout="constrained")
    panels = figure.subplots(3 if builds else 2, 1, sharex=True)
    handles = []
    for method in methods:
        pairs = [
            (scene, series)
            for scene, group in chosen.items()
            for series in group
            if series.method == method
        ]
        lights = [scene.lights for scene, _ in pairs]
        errors = [cost(series, scene).exp_interval() for scene, series in pairs]
        times = [sample_nanoseconds(series, scene) for scene, series in pairs]
        handles.append(_curve(panels[0], method, lights, errors, method))
        _curve(panels[1], method, lights, times, method)
        if all(series.build_seconds > 0 for _, series in pairs):
            built = [Interval(series.build_seconds) for _, series in pairs]
            _curve(panels[2], method, lights, built, method)
    panels[0].set_ylabel("error $\\times$ time\n(relative MSE $\\cdot$ s)")
    panels[1].set_ylabel("time of a sample (ns)")
    if builds:
        panels[2].set_ylabel("build of the tree (s)")
    for axes in panels:
        axes.set(xscale="log", yscale="log")
        _log_ticks(axes)
    panels[-1].set_xlabel("lights")
    _legend(figure, handles)
    return figure


# --- Sweeps of a parameter --------------------------------------------------------------------


def _sweeps(results: Results) -> Iterator[tuple]:
    for scene in results.scenes:
        for parameter in SWEPT:
            groups = grouping.sweeps(scene, parameter)
            if groups:
                title = f"{scene.title}: {parameter} ({SWEPT[parameter].symbol})"
                values = ", ".join(value_text(value) for value, _ in groups[0])
                alt = f"Error and time against {parameter} ({values}) in {scene.title}."
                figure = _sweep(scene, parameter, groups)
                yield f"sweep_{parameter}_{scene.name}", title, alt, figure


def _sweep(scene: Scene, parameter: str, groups: list[list[tuple]]) -> Figure:
    figure = Figure(figsize=(WIDTH, 7.2), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    # Values are set at equal distances: they are often powers of two, and may be 0 or inf.
    numbers = sorted({float(value) for group in groups for value, _ in group})
    handles, used = [], {}
    for group in groups:
        method = group[0][1].method
        places = [numbers.index(float(value)) for value, _ in group]
        points = [last_clear_point(series, scene) for _, series in group]
        errors = [log_mean_of(point.error_trimmed * point.spp).exp_interval() for point in points]
        times = [sample_nanoseconds(series, scene) for _, series in group]
        both = [cost(series, scene).exp_interval() for _, series in group]
        dash = DASHES[used.get(method, 0) % len(DASHES)]
        used[method] = used.get(method, 0) + 1
        label = grouping.label(group[0][1], without=parameter)
        handles.append(_curve(panels[0], method, places, errors, label, dash))
        _curve(panels[1], method, places, times, label, dash)
        _curve(panels[2], method, places, both, label, dash)
    labels = (
        "error $\\times$ samples a pixel",
        "time of a sample (ns)",
        "error $\\times$ time (s)",
    )
    for axes, text in zip(panels, labels):
        axes.set(yscale="log", ylabel=text)
        _log_ticks(axes, "y")
    panels[-1].set_xticks(range(len(numbers)), [f"{number:g}" for number in numbers])
    panels[-1].set_xlabel(parameter)
    _legend(figure, handles)
    return figure


# --- Standard deviation across a boundary of the cut ------------------------------------------


def _boundaries(deviations: Deviations) -> Iterator[tuple]:
    for scene, lines in deviations.items():
        if lines:
            ranges = "; ".join(f"{grouping.label(one)} {_range(line)}" for one, line in lines)
            alt = f"Standard deviation of one sample by column in {scene.title}: {ranges}"
            yield f"boundary_{scene.name}", scene.title, alt, _boundary(lines)


def _range(line: np.ndarray) -> str:
    return f"{line.min():.2g} to {line.max():.2g}"


def _boundary(lines: list[tuple[Series, np.ndarray]]) -> Figure:
    figure, axes = _figure()
    used = {}
    for index, (series, line) in enumerate(lines):
        color, marker = _look(series.method)
        dash = DASHES[used.get(series.method, 0) % len(DASHES)]
        used[series.method] = used.get(series.method, 0) + 1
        axes.plot(
            np.arange(len(line)),
            line,
            dash,
            color=color,
            marker=marker,
            # A few markers a line, those of other lines at other columns
            markevery=(index * 3, max(1, len(line) // 8)),
            label=grouping.label(series),
            linewidth=2.2 if series.ours else 1.4,
        )
    axes.set(xlabel="column (pixel)", ylabel="standard deviation of one sample\n(radiance)")
    values = np.concatenate([line[line > 0] for _, line in lines])
    if len(values) and values.max() > 20 * values.min():
        axes.set_yscale("log")
        _log_ticks(axes, "y")
    else:
        axes.set_ylim(bottom=0)
    _legend(figure, axes.get_legend_handles_labels()[0])
    return figure


# --- Shared -----------------------------------------------------------------------------------


def _figure(height: float = HEIGHT):
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots()


def _curve(axes, method, positions, intervals: list[Interval], label, dash="-") -> Line2D:
    """Draw values with their intervals as a band; return what the legend shows."""
    color, marker = _look(method)
    look = {"color": color, "marker": marker, "linestyle": dash, "label": label}
    axes.plot(positions, [one.value for one in intervals], **look, zorder=3)
    lows, highs = ([getattr(one, end) for one in intervals] for end in ("low", "high"))
    axes.fill_between(positions, lows, highs, color=color, alpha=0.2, linewidth=0)
    return Line2D([], [], **look)


def _look(method: str) -> tuple[str, str]:
    """Return colour and marker of a method."""
    about = ABOUT.get(method)
    return (about.color, about.marker) if about else OTHER_LOOK


def _ordered(methods) -> list[str]:
    """Sort names of methods: ours first, unknown ones last."""
    known = [name for name in ABOUT if name in methods]
    return known + sorted(set(methods) - set(known))


def _hollow(label: str) -> Line2D:
    return Line2D(
        [], [], color="#555555", marker="o", markerfacecolor="white", linestyle="", label=label
    )


def plain(text: str, width: int) -> str:
    """Break lines after ``width`` letters, and keep dollar signs from starting a formula."""
    return textwrap.fill(text, width).replace("$", r"\$")


def _legend(figure: Figure, handles: list[Line2D], columns: int = 2) -> None:
    if max((len(handle.get_label()) for handle in handles), default=0) > LONG_LABEL:
        columns = max(1, columns // 2)
    # More lines than usual make the figure taller, not the axes smaller.
    rows = math.ceil(len(handles) / columns)
    figure.set_figheight(figure.get_figheight() + LEGEND_ROW * max(0, rows - 4))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)


def _log_ticks(axes, which: str = "both") -> None:
    """Label powers of ten; over about two decades also their multiples by 2 and 5."""
    for name in ("x", "y") if which == "both" else (which,):
        axis = getattr(axes, f"{name}axis")
        low, high = getattr(axes, f"get_{name}lim")()
        decades = math.log10(high / low) if low > 0 else 1.0
        steps = (1.0, 2.0, 5.0) if decades < 2.2 else (1.0,)
        axis.set_major_locator(LogLocator(subs=steps, numticks=8))
        axis.set_major_formatter(FuncFormatter(_tick))
        # Unlabelled ticks between them would take half of the time of drawing.
        axis.set_minor_locator(NullLocator())


def _tick(value: float, _position: int) -> str:
    """Plain numbers where they are short, powers of ten elsewhere."""
    if 0.001 <= value < 10_000:
        return f"{value:g}"
    exponent = math.floor(math.log10(value) + 1e-9)
    factor = value / 10**exponent
    power = f"$10^{{{exponent}}}$"
    return power if abs(factor - 1) < 1e-6 else f"${factor:g}\\cdot${power}"

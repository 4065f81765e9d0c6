"""Writes ``README.md`` beside the results: the tables of the page, for who reads the repository."""

from __future__ import annotations

import textwrap
from pathlib import Path

from manylights import files
from manylights.bench.methods import ABOUT, MITSUBAS, OURS
from manylights.bench.records import Results, Scene, Series
from manylights.report import grouping, tables
from manylights.report.statistics import gain, is_mostly_preparation, sample_nanoseconds
from manylights.report.text import number, percent, ratio

NAME = "README.md"

#: What is written by hand, linked if it is there.
MORE = "more.md"

#: The first line of text: a file without it is somebody else's.
ORIGIN = "`manylights report` writes this page from `results.json`: it is not edited by hand."


def write_readme(data: Results, charts: Path) -> list[str]:
    """Write the page into the folder of the results, unless a file of another origin is there.

    Args:
        data: what was measured.
        charts: folder of the charts, inside of that of the results.

    Returns:
        Remarks on what was left as it was.
    """
    target = data.folder / NAME
    if target.exists() and ORIGIN not in target.read_text(encoding="utf-8", errors="replace"):
        return [f"{target}: not written by this command, left as it is"]
    with files.written_whole(target) as partial:
        partial.write_text(render(data, charts), encoding="utf-8")
    return []


def render(data: Results, charts: Path) -> str:
    """Return the text of the page: the same for the same measurements and names of charts."""
    parts = [
        "# Measurements",
        _head(data),
        *_charts(data, charts),
        *_comparison(data),
        *_losses(data),
        *_times(data),
        *_checks(data),
    ]
    return "\n\n".join(map(_wrapped, parts)) + "\n"


def _wrapped(part: str) -> str:
    """Break the lines of text; tables, headings, lists and pictures stay."""
    if part[0] in "|#-!":
        return part
    return "\n\n".join(
        textwrap.fill(paragraph, 100, break_long_words=False, break_on_hyphens=False)
        for paragraph in part.split("\n\n")
    )


def _head(data: Results) -> str:
    machine = data.machine
    versions = ", ".join(f"{name} {version}" for name, version in data.versions.items())
    day = data.created.partition("T")[0]
    more = ""
    if (data.folder / MORE).exists():
        more = f"\n\nWhat was measured in other ways is in [{MORE}]({MORE})."
    return (
        f"{ORIGIN}\n\n"
        f"{len(data.scenes)} scenes, begun on {day} in `{data.variant}` on "
        f"{machine.get('processor', 'an unnamed processor')} with {machine.get('threads', '?')} "
        f"threads ({versions}). Times are those of renders after the first one: without "
        "compilation and without building the tree. Errors are relative mean squared errors, "
        f"without the worst {100 * data.metric['trim']:g} % of the pixels unless said otherwise."
        f"{more}"
    )


def _charts(data: Results, charts: Path) -> list[str]:
    """Show the charts that there are of all scenes, of families, and across boundaries."""
    alts = {"overview": "Error against time in all scenes"}
    for family in grouping.families(data):
        alts[f"lights_{family}"] = f"Error, time and build time by number of lights: {family}"
    for scene in data.scenes:
        if scene.boundary:
            alts[f"boundary_{scene.name}"] = f"Standard deviation by column: {scene.title}"
    shown = [(name, alt) for name, alt in alts.items() if (charts / f"{name}.svg").exists()]
    return [f"![{alt}]({charts.name}/{name}.svg)" for name, alt in shown]


# --- Error and time ---------------------------------------------------------------------------


def _comparison(data: Results) -> list[str]:
    methods = [name for name in (*MITSUBAS, *OURS[1:]) if _measured(data, name)]
    if not methods:
        return []
    heads = ["scene", "lights", "ns a sample: Mitsuba's, ours", *(f"`{name}`" for name in methods)]
    rows = []
    for scene in data.scenes:
        ours = grouping.ours(scene)
        if ours:
            best = {series.method: series for series in grouping.one_a_method(scene)}
            gains = [_gain(best.get(name), ours, scene) for name in methods]
            rows.append([scene.title, f"{scene.lights:,}", _nanoseconds(scene, best), *gains])
    summary = [
        [f"`{row.method}`", str(row.scenes), *map(number, (row.median, row.low, row.high))]
        for row in tables.summaries(data)
    ]
    about = "\n".join(f"- `{name}`: {ABOUT[name].meaning}" for name in (OURS[0], *methods))
    return [
        "## Error after the same time, ours = 1",
        f"Error of each method, with its best setting, divided by that of `{OURS[0]}` as it comes, "
        "after the time of the longest renders of ours. Times are without what does not grow with "
        "the samples, such as recorded kernels: the slope between the two longest renders counts. "
        "The error of a peer is taken to be a power of the time between its measurements, and to "
        'fall as 1 / time outside. Above 1 ours is better; "<": renders of the peer are mostly '
        "preparation, and a tenth of their time is taken for that of the samples.",
        _table(heads, rows),
        about,
        *_samplers(data),
        "Over all scenes:",
        _table(["method", "scenes", "median", "lowest", "highest"], summary),
    ]


def _samplers(data: Results) -> list[str]:
    """Say which samplers methods had; those of Mitsuba's integrators differ between scenes."""
    found: dict[str, dict[str, list[str]]] = {"ours": {}, "Mitsuba's": {}}
    for scene in data.scenes:
        for series in scene.series:
            owner = "Mitsuba's" if series.mitsubas else "ours"
            if series.sampler:
                scenes = found[owner].setdefault(series.sampler, [])
                scenes += [] if scene.title in scenes else [scene.title]
    lines = []
    for owner, samplers in found.items():
        names = [
            f"`{name}`" + (f" ({'; '.join(scenes)})" if len(samplers) > 1 else "")
            for name, scenes in sorted(samplers.items())
        ]
        lines += [f"- {owner}: {', '.join(names)}"] if names else []
    if not lines:
        return []
    return ["Samplers, for Mitsuba's integrators the best of Mitsuba's:", "\n".join(lines)]


def _measured(data: Results, method: str) -> bool:
    return any(series.method == method for scene in data.scenes for series in scene.series)


def _gain(peer: Series | None, ours: Series, scene: Scene) -> str:
    if peer is None:
        return ""
    return "< " * is_mostly_preparation(peer) + number(gain(peer, ours, scene).value)


def _nanoseconds(scene: Scene, best: dict[str, Series]) -> str:
    """Return the time of a sample of Mitsuba's uniform sampling and of ours."""
    return ", ".join(
        number(sample_nanoseconds(best[name], scene).value) if name in best else "-"
        for name in (MITSUBAS[0], OURS[0])
    )


def _losses(data: Results) -> list[str]:
    rows = tables.efficiencies(data, every=True)
    lost = [row for row in rows if row.lost]
    if not rows:
        return []
    heading = "## Where it does not win"
    if not lost:
        return [heading, f"In none of {len(rows)} comparisons did a peer have less error."]
    return [
        heading,
        f"Of {len(rows)} comparisons, all settings of all peers included, these are the "
        f"{len(lost)} in which the peer's error was lower, trimmed or not, with 95 % intervals.",
        _table(
            ["scene", "peer", "trimmed", "all pixels", "better"],
            [
                [row.scene.title, row.peer, ratio(row.trimmed), ratio(row.untrimmed), row.verdict]
                for row in lost
            ],
        ),
    ]


# --- Times and checks -------------------------------------------------------------------------


def _times(data: Results) -> list[str]:
    rows = []
    for scene in data.scenes:
        ours = grouping.ours(scene)
        if ours:
            cells = (1e3 * ours.build_seconds, ours.first_seconds)
            rows.append([scene.title, f"{scene.lights:,}", *map(number, cells)])
    if not rows:
        return []
    return [
        "## Before the first image",
        "Building the tree, and the whole first render of one sample a pixel, kernels compiled.",
        _table(["scene", "lights", "tree (ms)", "first render (s)"], rows),
    ]


def _checks(data: Results) -> list[str]:
    biases = tables.biases(data)
    outside = [row for row in biases if row.holds_zero is False]
    parts = [
        "## Means and references",
        f"Of {len(biases)} means of longest renders {len(outside)} are outside of their 95 % "
        f"interval around the reference's mean; by chance it is {0.05 * len(biases):.1f}. Methods "
        "of one scene are compared with the same reference, so they are often outside together.",
    ]
    if outside:
        rows = [
            [row.scene.title, row.label, *map(percent, _ends(row.difference))] for row in outside
        ]
        parts.append(_table(["scene", "method", "difference", "from", "to"], rows))
    references = [
        [
            scene.title,
            f"{scene.width} x {scene.height}",
            f"`{scene.reference['integrator']}`",
            f"{scene.reference['spp']:,}",
            number(scene.reference["error"]),
        ]
        for scene in data.scenes
    ]
    heads = ["scene", "pixels", "reference by", "samples a pixel", "its error"]
    return [*parts, _table(heads, references)]


def _ends(interval) -> tuple[float, float, float]:
    return interval.value, interval.low, interval.high


def _table(heads: list[str], rows: list[list[str]]) -> str:
    """Return a table of Markdown; vertical bars in cells are not allowed to end them."""
    lines = [heads, ["---"] * len(heads), *rows]
    cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)

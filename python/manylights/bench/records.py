"""The file ``results.json``: what it holds, new entries for it, and reading it with all checks.

``bench`` writes it, ``report`` reads it; the tables below are the only place that says what is in
it. A new number is added to one of them, and to the class of the same name if the report shows it.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from manylights.bench.methods import MITSUBAS, OURS
from manylights.errors import UsageError

#: Name of the file, and the only version of it that this module reads.
FILE, FORMAT = "results.json", 1

NUMBER = (int, float)
#: Names become parts of paths: nothing that leaves the folder or hides a file.
NAME = re.compile(r"\w[\w.+-]*")
SPEC = re.compile(r"\w[\w.+:=-]*")


@dataclass(frozen=True)
class Maybe:
    """Kind of a value that may be null or missing."""

    kind: Any


# What the file has to hold: types, lists of one kind, and objects with at least these names.
# Lists of a point have one value a seed, but FLIP, which the first seeds alone have.
POINT = {
    "spp": int,
    "seed": [int],
    "seconds": [NUMBER],
    "cpu_seconds": [NUMBER],
    "error": [NUMBER],
    "error_trimmed": [NUMBER],
    "flip": [NUMBER],
    "mean": [NUMBER],
}
EQUAL_TIME = {
    "spp": int,
    "seconds": NUMBER,
    "error": NUMBER,
    "error_trimmed": NUMBER,
    "flip": Maybe(NUMBER),
}
SERIES = {
    "spec": str,
    "method": str,
    "parameters": dict,
    "integrator": dict,
    "sampler": Maybe(str),
    "build_seconds": NUMBER,
    "first_seconds": NUMBER,
    "equal_time": Maybe(EQUAL_TIME),
    "points": [POINT],
    "denoised": Maybe([POINT]),
}
REFERENCE = {
    "integrator": str,
    "spp": int,
    "seconds": NUMBER,
    "error": NUMBER,
    "mean": NUMBER,
    "mean_error": NUMBER,
}
SCENE = {
    "name": str,
    "title": str,
    "family": Maybe(str),
    "lights": int,
    "source": str,
    "hash": str,
    "width": int,
    "height": int,
    "max_depth": Maybe(int),
    "media": bool,
    "private": bool,
    "boundary": bool,
    "equal_time": Maybe(NUMBER),
    "reference": Maybe(REFERENCE),
    "series": [SERIES],
    "skipped": Maybe([{"spec": str, "why": str}]),
    "finished": Maybe(bool),
}
RESULTS = {
    "format": int,
    "created": str,
    "versions": dict,
    "machine": dict,
    "variant": str,
    "metric": {"epsilon": NUMBER, "trim": NUMBER},
    "scenes": [SCENE],
}


@dataclass(frozen=True, eq=False)
class Point:
    """Renderings with one number of samples per pixel; each array has one value a seed."""

    spp: int
    seconds: np.ndarray
    cpu_seconds: np.ndarray
    error: np.ndarray
    error_trimmed: np.ndarray
    mean: np.ndarray


@dataclass(frozen=True, eq=False)
class Series:
    """One method with its parameters in one scene; points with rising numbers of samples.

    Those of denoised images are of renders of their own, with albedo and normals, and their times
    include the denoiser's.
    """

    spec: str
    method: str
    parameters: dict[str, Any]
    sampler: str | None
    build_seconds: float
    first_seconds: float
    equal_time: dict[str, Any] | None
    points: list[Point]
    denoised: list[Point] = field(default_factory=list)

    @property
    def key(self) -> str:
        """First part of the names of the images."""
        return re.sub("[:=]", "-", self.spec)

    @property
    def ours(self) -> bool:
        """Whether this is the method that the others are compared with."""
        return self.method == OURS[0]

    @property
    def mitsubas(self) -> bool:
        """Whether this is Mitsuba's own integrator, which has no parameters and no tree."""
        return self.method in MITSUBAS


@dataclass(frozen=True, eq=False)
class Scene:
    """One scene, its reference and all series measured in it; images are in ``folder``."""

    folder: Path
    name: str
    title: str
    family: str | None
    lights: int
    source: str
    width: int
    height: int
    max_depth: int | None
    media: bool
    private: bool
    boundary: bool
    equal_time: float | None
    reference: dict[str, Any]
    series: list[Series]
    skipped: list[dict[str, str]] | None

    @property
    def pixels(self) -> int:
        return self.width * self.height


@dataclass(frozen=True, eq=False)
class Results:
    """All of ``results.json`` that can be shown; ``remarks`` say what cannot."""

    folder: Path
    created: str
    versions: dict[str, Any]
    machine: dict[str, Any]
    variant: str
    metric: dict[str, float]
    scenes: list[Scene]
    remarks: list[str]


def new_point(spp: int) -> dict[str, Any]:
    """Return an entry for renders of so many samples per pixel, without any."""
    return {name: [] if isinstance(kind, list) else spp for name, kind in POINT.items()}


def new_series(
    spec: str,
    method: str,
    parameters: dict[str, Any],
    integrator: dict[str, Any],
    sampler: str,
) -> dict[str, Any]:
    """Return an entry for a method that has not been rendered."""
    return {
        "spec": spec,
        "method": method,
        "parameters": parameters,
        "integrator": integrator,
        "sampler": sampler,
        "build_seconds": 0.0,
        "first_seconds": 0.0,
        "equal_time": None,
        "points": [],
    }


def new_scene(facts: dict[str, Any]) -> dict[str, Any]:
    """Return an entry for a scene that has not been measured; ``facts`` has what is known."""
    return {**facts, "reference": None, "series": [], "skipped": []}


def read(path: Path) -> dict[str, Any]:
    """Return the content of the file, checked.

    Raises:
        UsageError: no such file, or it is not what ``manylights bench`` writes; the text names
            the file, the place in it, and what is wrong.
    """
    data = _read_json(path)
    try:
        _check_format(data)
        _check(data, RESULTS, "")
        for index, scene in enumerate(data["scenes"]):
            _check_scene(scene, f"scenes[{index}]")
        _check_distinct([scene["name"] for scene in data["scenes"]], "scenes")
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from None
    return data


def load(folder: str) -> Results:
    """Return what ``folder``/results.json holds and can be shown.

    Raises:
        UsageError: as ``read``.
    """
    path = Path(folder) / FILE
    data = read(path)
    remarks: list[str] = []
    found = [_scene(path.parent, scene, remarks) for scene in data["scenes"]]
    scenes = [scene for scene in found if scene]
    return Results(**_known(Results, data), folder=path.parent, scenes=scenes, remarks=remarks)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file, write it with: manylights bench") from None
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(f"{path}: not JSON: {error}") from None


def _check_format(data: Any) -> None:
    if not isinstance(data, dict) or "format" not in data:
        raise ValueError("format: missing, these are not results of manylights bench")
    if data["format"] != FORMAT:
        raise ValueError(f"format: {data['format']!r} is unknown, this version reads {FORMAT}")


def _check(value: Any, kind: Any, where: str) -> None:
    """Raise ValueError, with the place of the fault, unless ``value`` is of ``kind``."""
    if isinstance(kind, Maybe):
        if value is not None:
            _check(value, kind.kind, where)
    elif isinstance(kind, list):
        _check_type(value, list, where)
        for index, entry in enumerate(value):
            _check(entry, kind[0], f"{where}[{index}]")
    elif isinstance(kind, dict):
        _check_type(value, dict, where)
        for name, inner in kind.items():
            place = f"{where}.{name}" if where else name
            if name not in value and not isinstance(inner, Maybe):
                raise ValueError(f"{place}: missing")
            _check(value.get(name), inner, place)
    else:
        _check_type(value, kind, where)


def _check_type(value: Any, kind: Any, where: str) -> None:
    # To Python, true is an integer.
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        names = [one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,))]
        raise ValueError(f"{where}: {type(value).__name__} instead of {' or '.join(names)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{where}: {value} is not a finite number")


def _check_scene(scene: dict[str, Any], where: str) -> None:
    _check_name(scene["name"], NAME, f"{where}.name")
    _check_positive(scene, ("lights", "width", "height"), where)
    for index, series in enumerate(scene["series"]):
        place = f"{where}.series[{index}]"
        _check_name(series["spec"], SPEC, f"{place}.spec")
        for kind in ("points", "denoised"):
            for number, point in enumerate(series.get(kind) or ()):
                _check_point(point, f"{place}.{kind}[{number}]")
    _check_distinct([series["spec"] for series in scene["series"]], f"{where}.series")


def _check_point(point: dict[str, Any], where: str) -> None:
    _check_positive(point, ("spp",), where)
    seeds = len(point["seconds"])
    for name in ("cpu_seconds", "error", "error_trimmed", "mean"):
        if len(point[name]) != seeds:
            raise ValueError(f"{where}.{name}: {len(point[name])} values for {seeds} seeds")
    for name in ("seconds", "error", "error_trimmed"):
        if min(point[name], default=0) < 0:
            raise ValueError(f"{where}.{name}: negative")


def _check_name(name: str, pattern: re.Pattern, where: str) -> None:
    if not pattern.fullmatch(name):
        raise ValueError(f"{where}: {name!r} cannot be part of a file name")


def _check_positive(entry: dict[str, Any], names: tuple[str, ...], where: str) -> None:
    for name in names:
        if entry[name] < 1:
            raise ValueError(f"{where}.{name}: {entry[name]} is less than 1")


def _check_distinct(names: list[str], where: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{where}: {name} is there twice")


def _scene(folder: Path, entry: dict[str, Any], remarks: list[str]) -> Scene | None:
    """Return a scene, None if it has no reference, as after an interrupted run."""
    name = entry["name"]
    if entry["reference"] is None:
        remarks.append(f"{name}: has no reference yet, left out")
        return None
    series = [_series(one, name, remarks) for one in entry["series"]]
    series = [one for one in series if one.points]
    return Scene(**_known(Scene, entry), folder=folder / name, series=series)


def _series(entry: dict[str, Any], scene: str, remarks: list[str]) -> Series:
    """Return a series with the points that have logarithms."""
    points = _points(entry["points"])
    if len(points) < len(entry["points"]) or not points:
        remarks.append(f"{scene}, {entry['spec']}: points not rendered yet, or with error 0")
    return Series(
        **_known(Series, entry), points=points, denoised=_points(entry.get("denoised") or [])
    )


def _points(entries: list[dict[str, Any]]) -> list[Point]:
    """Return the points that have logarithms, by rising numbers of samples."""
    points = [_point(entry) for entry in entries if _is_positive(entry)]
    return sorted(points, key=lambda point: point.spp)


def _is_positive(point: dict[str, Any]) -> bool:
    """Whether the means of errors and times are positive; those of no seeds are not."""
    return all(sum(point[name]) > 0 for name in ("seconds", "error", "error_trimmed"))


def _point(entry: dict[str, Any]) -> Point:
    names = (one.name for one in fields(Point) if one.name != "spp")
    return Point(entry["spp"], **{name: np.array(entry[name], float) for name in names})


def _known(kind: type, entry: dict[str, Any]) -> dict[str, Any]:
    """Return the values of an entry for the fields of a class that are not made of others.

    They are None where the entry has none.
    """
    made = ("folder", "scenes", "series", "points", "denoised", "remarks")
    return {one.name: entry.get(one.name) for one in fields(kind) if one.name not in made}

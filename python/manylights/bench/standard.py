"""The scenes that ``manylights bench --standard`` and ``--quick`` measure."""

from __future__ import annotations

from manylights.bench import methods, scene_source
from manylights.bench.methods import Method
from manylights.bench.runner import Task

#: Budgets of a render in seconds: --standard is to end within an hour on two cores, --quick within
#: five minutes.
STANDARD_BUDGET, QUICK_BUDGET = 0.5, 0.15

#: Values of single parameters, around their defaults, that show what the parameters do.
SPLITTING_RATES = (0, 0.5, 1, 2, 4)
RESERVOIRS, SHADOW_RAYS = (4, 8, 16, 32), (1, 2, 4, 8, 16)

SWEEPS = (
    *(f"resampled_tree:splitting_rate={value}" for value in SPLITTING_RATES),
    *(f"resampled_tree:reservoirs={value}" for value in RESERVOIRS),
    *(f"resampled_tree:shadow_rays={value}" for value in SHADOW_RAYS),
    *(f"talk:splitting_rate={value}" for value in SPLITTING_RATES),
    *(f"talk:splitting_rate={value}:split_function=far" for value in SPLITTING_RATES),
)

#: What is lost where lights are hidden and nobody learns that.
NOT_LEARNT = ("resampled_tree:learn_visibility=false",)


def standard() -> list[Task]:
    """Return the scenes of ``--standard``.

    Meshes store their emission in a texture, on which Mitsuba chooses points by radiance: the best
    it can do. ``glossy_10k`` and the scenes with a single light are those in which choosing lights
    well gains little or nothing.
    """
    path, fog = "integrator=path,max_depth=6", "max_depth=4"
    return [
        *(_city(lights) for lights in (10, 100)),
        _city(1_000, (*SWEEPS, *NOT_LEARNT)),
        *(_city(lights) for lights in (10_000, 100_000, 1_000_000)),
        _task("city_points_1k", "City, 1,000 points", "city:1000,kind=points", SWEEPS),
        _task("rooms_1k", "Rooms, paths of 5 bounces", f"rooms:1000,{path}", NOT_LEARNT),
        _task("house_1k", "House with doors, 1,000 bulbs", "house:1000", NOT_LEARNT, "house"),
        _task("house_10k", "House with doors, 10,000 bulbs", "house:10000", NOT_LEARNT, "house"),
        _task("fog_rooms_1k", "Rooms in fog, 3 bounces", f"fog_rooms:1000,{fog}", NOT_LEARNT),
        _task("fog_open_1k", "Field in fog, 3 bounces", f"fog_open:1000,{fog}", NOT_LEARNT),
        _task("glossy_1k", "Rough metal, 1,000 lamps", "glossy:1000", family="glossy"),
        _task("glossy_10k", "Rough metal, 10,000 lamps", "glossy:10000", family="glossy"),
        _task("behind_wall", "Bright lights behind a wall", "behind_wall:1000", NOT_LEARNT),
        _task("bright_far", "One bright light far away", "bright_far:1000"),
        _task("one_light", "A single point light", "open_plane:1"),
        _task("one_light_path", "A single point light, paths", f"open_plane:1,{path}"),
        _task("one_light_fog", "A single point light in fog", f"fog_open:1,{fog}"),
        _boundary(),
    ]


def quick() -> list[Task]:
    """Return the scenes of ``--quick``, direct light only."""
    return [
        *(_city(lights) for lights in (100, 10_000)),
        _task("city_points_1k", "City, 1,000 points", "city:1000,kind=points"),
        _boundary(),
    ]


def all_methods() -> list[Method]:
    """Return every method, with default parameters."""
    return [Method(name) for name in methods.NAMES]


def _city(lights: int, sweeps: tuple[str, ...] = ()) -> Task:
    short = f"{lights // 10**6}M" if lights >= 10**6 else f"{lights // 1000}k"
    name = f"city_{short if lights >= 1000 else lights}"
    return _task(name, f"City, {lights:,} lit triangles", f"city:{lights}", sweeps, family="city")


def _boundary() -> Task:
    task = _task("cut_boundary", "Strip of a floor under three clusters", "cut_boundary:300")
    task.boundary = True
    return task


def _task(
    name: str, title: str, source: str, sweeps: tuple[str, ...] = (), family: str = ""
) -> Task:
    chosen = [*all_methods(), *(methods.parse(spec) for spec in sweeps)]
    return Task(scene_source.find(source), chosen, name, title, family or name)

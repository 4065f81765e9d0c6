"""A render with all that its image depends on."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.errors import UsageError, argument, integer, number, typed
from manylights.loading import LoadedScene, light_groups
from manylights.output import images
from manylights.rendering import plan as plans
from manylights.rendering.driver import ENTRIES, Driver, Report
from manylights.rendering.parts import WHOLE, Part
from manylights.rendering.state import State
from manylights.rendering.targets import MOST_SPP, Course, History

#: Of the files that keep the state of a job; another one is refused.
FORMAT = 3

#: Facts in files about what was rendered so far.
STATE = ("history", "channels", "shown", "learnt", "sequences", "runs", "processors", "command")
STATE += ("samples_done", "checksum", "seeds", "samples", "seconds_taken", "parameters", "noise")

#: Films that can be made anew from what a file says, to develop the sums of parts.
FILMS = ("HDRFilm",)

#: A target counts as reached up to this factor: predictions are not exact.
NEARLY = 1.1


@dataclass
class Job:
    """What is to be rendered; make it with ``Job.of``.

    Attributes:
        loaded: the scene.
        index: of the sensor, from 0.
        seed: of the random numbers.
        course: which steps there are.
        driver: renders them.
        part: that was asked for, if any.
    """

    loaded: LoadedScene
    index: int
    seed: int
    course: Course
    driver: Driver
    part: Part | None = None

    @staticmethod
    def of(
        loaded: LoadedScene,
        sensor: int = 0,
        spp: int | None = None,
        seed: int = 0,
        noise: float | None = None,
        seconds: float | None = None,
        integrator=None,
        part: Part | tuple[int, int] | None = None,
    ) -> Job:
        """Plan a render.

        Args:
            loaded: what ``load`` returned.
            sensor: index of the sensor.
            spp: samples per pixel, >= 1, at most if there is a target. Default: what the scene's
                sampler says, with a target 65536.
            seed: of the random numbers, 0 to 2^32 - 1.
            noise: to stop at, relative, > 0. Default: none.
            seconds: to stop after, > 0. Default: none.
            integrator: ``mi.Integrator``. Default: the scene's.
            part: of several, which has some of the steps: number, from 1, and count. Default: all.

        Raises:
            UsageError: there is no such sensor, a number is out of range, or there are no parts of
                such a render.
        """
        sensors = loaded.scene.sensors()
        if not sensors:
            raise UsageError("the scene has no sensor")
        sensor = integer("sensor", sensor, 0, len(sensors) - 1)
        spp = None if spp is None else integer("spp", spp, 1, 2**32 - 1)
        seed = integer("seed", seed, 0, 2**32 - 1)
        noise, seconds = _target("until_noise", noise), _target("seconds", seconds)
        driver = Driver(loaded, sensors[sensor], integrator)
        _check_film(driver)
        _check_groups(driver)
        part = Part.of(part)
        if part is not None:
            _check_part(part, driver)
        if spp is None:
            aimless = noise is None and seconds is None
            spp = driver.sensor.sampler().sample_count() if aimless else MOST_SPP
        course = Course(spp, driver.limits(), noise, seconds, part or WHOLE)
        return Job(loaded, sensor, seed, course, driver, part)

    @property
    def film(self):
        """The sensor's film, which each step overwrites."""
        return self.driver.sensor.film()

    def seed_of(self, step: plans.Step) -> int:
        """Return the seed of a step: that of its sequence."""
        number = step.scramble if self.course.limits.indexed else step.index
        return plans.seed_of(self.seed, number)

    def render(self, step: plans.Step, report: Report = lambda done: None) -> np.ndarray:
        """Render a step with its random numbers; return the film's sums (``Driver.render``)."""
        return self.driver.render(step, self.seed_of(step), self.course.spp, report)

    def add_nothing(self, state: State) -> None:
        """Make the film, which no step has made, and the sums if there are none."""
        state.sums[0].add(self.driver.blank())
        state.channels = self.driver.channels()

    def notes(self, done: History, noise: float | None) -> list[str]:
        """Return what is to be said at the end of a render."""
        course, result = self.course, []
        count, part = course.step_count, course.part
        if count is not None and part.count > count:
            empty = "" if part.steps(count) else f"{part.words()} is empty, "
            steps = "1 step" if count == 1 else f"{count} steps"
            result.append(f"parts: this render has {steps}, {empty}at most {count} share the work")
        if not course.limits.indexed and done.steps > 1:
            name = self.driver.sensor.sampler().class_name()
            result.append(
                f"sampler: {name} has no samples by index: {done.steps} steps, each with a "
                "sequence of its own (manylights_sobol has one for all)"
            )
        if course.noise is not None and noise is None:
            result.append(f"noise: not known, {done.spp} samples per pixel are too few")
        elif course.noise is not None and noise > NEARLY * course.noise:
            result.append(
                f"noise: {noise:.3g} was reached and not {course.noise:g}, with "
                f"{done.spp} samples per pixel"
            )
        return result

    def facts(self) -> dict[str, Any]:
        """Return all that the image depends on, for JSON."""
        from manylights import __version__

        width, height = map(int, self.film.crop_size())
        groups = light_groups.of_integrator(self.driver.integrator)
        return {
            "version": f"manylights {__version__}, Mitsuba {mi.__version__}",
            "format": FORMAT,
            "variant": mi.variant(),
            "spp": self.course.spp,
            "until_noise": self.course.noise,
            "seconds": self.course.seconds,
            "seed": self.seed,
            "sensor": self.index,
            "size": f"{width} x {height}",
            "sampler": self.driver.sensor.sampler().class_name(),
            "steps": self.course.limits.largest(),
            "step_count": self.course.step_count,
            "part": str(self.course.part),
            "film": self.film.class_name(),
            "number": np.dtype(images.number_of(self.film)).name,
            "adjoint": self.driver.adjoint,
            "exposure": self.loaded.exposure,
            **self.loaded.choices,
            **({"light_groups": groups} if groups else {}),
            "files": _digests(self.loaded.files) or {"scene": _digest(self.loaded.scene)},
        }


def differences(old: dict[str, Any], new: dict[str, Any], but: tuple[str, ...] = ()) -> list[str]:
    """Return in words what the facts of two jobs do not share, the old one's value first.

    What files say of their state is not compared, nor are the facts ``but``.
    """
    names = [name for name in {**new, **old} if name not in (*STATE, *but)]
    changed = [name for name in names if old.get(name) != new.get(name)]
    changes = [
        f"{name} {_words(old.get(name))} and not {_words(new.get(name))}"
        for name in changed
        if name != "files"
    ]
    if "files" in changed:
        before, now = old.get("files", {}), new.get("files", {})
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        changes.append(f"another content of {', '.join(names)}")
    return changes


def _check_part(part: Part, driver: Driver) -> None:
    """Raise ``UsageError`` if parts of this cannot be added."""
    film = driver.sensor.film().class_name()
    if film not in FILMS:
        raise UsageError(f"{part.words()}: parts of a {film} cannot be merged, only of an hdrfilm")


def _check_film(driver: Driver) -> None:
    """Refuse films without pixels, and those of which Dr.Jit cannot have an array."""
    width, height = map(int, driver.sensor.film().crop_size())
    channels = 4 + len(driver.integrator.aov_names())
    if width * height == 0:
        raise UsageError(f"film {width} x {height}: must be at least 1 x 1")
    if width * height * channels >= 2**32:
        raise UsageError(
            f"film {width} x {height}: {width * height * channels:,} numbers in {channels} "
            "channels, must be less than 2^32"
        )


def _check_groups(driver: Driver) -> None:
    """Raise ``UsageError`` if light groups are asked for and film or lights cannot have them."""
    groups = light_groups.of_integrator(driver.integrator)
    if not groups:
        return
    film = driver.sensor.film()
    known = re.search(r"pixel_format = (\w+)", str(film))
    plain = film.class_name() in FILMS and known and known[1] in ("rgb", "rgba")
    if not plain:
        what = f"has pixel_format {known[1]}" if known else f"is a {film.class_name()}"
        todo = 'type <string name="pixel_format" value="rgb"/> in an hdrfilm'
        backend, mono, _ = mi.variant().partition("_mono")
        if mono:
            # Mitsuba's films have luminance there, whatever they are told
            what, todo = (
                f"has no colours in {mi.variant()}",
                f"{typed('the variant', '--variant')} {backend}_rgb has them",
            )
        raise UsageError(
            f"{argument('light_groups')}: the film {what}, layers need pixel_format rgb or rgba: "
            f"{todo}"
        )
    if light_groups.entry_of(groups, "") is None and not light_groups.are_named(driver.scene):
        raise UsageError(
            f"{argument('light_groups')} {groups}: no light of the scene has an id, nor has its "
            'shape, give them some: <emitter type="point" id="lamp_1">'
        )


def _target(name: str, value) -> float | None:
    """Return a noise or a time that was asked for, None for none."""
    if value is None:
        return None
    return number(name, value, lambda number: 0.0 < number < np.inf, "a number above 0")


def _digests(paths: list[Path]) -> dict[str, str]:
    """Return SHA-256 of the files by their names, seen from the folder of the first."""
    folder = paths[0].parent if paths else ""
    return {
        os.path.relpath(path, folder): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in dict.fromkeys(paths)
    }


def _digest(scene) -> str:
    """Return SHA-256 of all parameters of a scene that came from no file.

    The order of the shapes does not matter: that of meshes that Mitsuba has merged is by chance.
    """
    shapes, known = scene.shapes(), {}
    # Objects without an id have their address in the name.
    owned = (*(f"{shape.id()}." for shape in shapes if shape.id()), "object_")
    parts = [_digest_of(scene, lambda name: not name.startswith(owned))]
    parts += sorted(_digest_of_shape(shape, known) for shape in shapes)
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def _digest_of_shape(shape, known: dict[int, tuple]) -> str:
    """Return SHA-256 of a shape and its parts; ``known`` has those that others share, too."""
    children = {
        "bsdf": shape.bsdf(),
        "emitter": shape.emitter(),
        "interior_medium": shape.interior_medium(),
        "exterior_medium": shape.exterior_medium(),
    }
    inside = tuple(f"{name}." for name in children)
    parts = [shape.id(), _digest_of(shape, lambda name: not name.startswith(inside))]
    for name, child in children.items():
        if child is not None:
            if id(child) not in known:
                known[id(child)] = child, _digest_of(child, lambda _: True)
            parts.append(f"{name} {known[id(child)][1]}")
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def _digest_of(part, chosen: Callable[[str], bool]) -> str:
    """Return SHA-256 of those parameters of an object of which the names are chosen."""
    digest = hashlib.sha256()
    parameters = mi.traverse(part)
    for name in filter(chosen, parameters.keys()):
        *_, flags = parameters.properties[name]
        # Renders themselves change these.
        if flags & mi.ParamFlags.ReadOnly or name.endswith(ENTRIES):
            continue
        value = parameters[name]
        digest.update(f"{name.rpartition('.')[2]} {type(value).__name__} ".encode())
        try:
            digest.update(np.ascontiguousarray(getattr(value, "matrix", value)).tobytes())
        except (TypeError, ValueError):
            digest.update(str(value).encode())
    return digest.hexdigest()


def _words(value: Any) -> str:
    """Return a fact for people: options that are given several times as typed."""
    if isinstance(value, dict):
        return " ".join(f"{name}={item}" for name, item in value.items()) or "none"
    return "none" if value is None else str(value)

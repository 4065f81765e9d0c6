"""A render with all that its image depends on."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.errors import UsageError
from manylights.loading import LoadedScene
from manylights.rendering import plan as plans


@dataclass
class Job:
    """What is to be rendered; make it with ``Job.of``.

    Attributes:
        loaded: the scene.
        index: of the sensor, from 0.
        seed: of the random numbers.
        plan: the passes.
        choices: what else was chosen on the command line, by the name of the option.
    """

    loaded: LoadedScene
    index: int
    seed: int
    plan: plans.Plan
    choices: dict[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(
        loaded: LoadedScene,
        sensor: int = 0,
        spp: int = 0,
        seed: int = 0,
        choices: dict[str, Any] | None = None,
        keeps_state: bool = False,
    ) -> Job:
        """Plan a render.

        Args:
            loaded: what ``load`` returned.
            sensor: index of the sensor.
            spp: samples per pixel, >= 1, or 0 for what the scene's sampler says.
            seed: of the random numbers, 0 to 2^32 - 1.
            choices: what else the image depends on, by the name of the option. Default: nothing.
            keeps_state: will the state be kept between passes?

        Raises:
            UsageError: there is no such sensor.
        """
        sensors = loaded.scene.sensors()
        if not 0 <= sensor < len(sensors):
            raise UsageError(f"--sensor {sensor}: the scene has {len(sensors)}, counted from 0")
        spp = spp or sensors[sensor].sampler().sample_count()
        scalar = is_scalar()
        if scalar and not keeps_state:
            plan = plans.whole(spp, seed)
        else:
            pixels = int(np.prod(sensors[sensor].film().crop_size()))
            plan = plans.split(spp, pixels, seed, scalar)
        return Job(loaded, sensor, seed, plan, choices or {})

    @property
    def sensor(self):
        """Mitsuba's sensor."""
        return self.loaded.scene.sensors()[self.index]

    @property
    def film(self):
        """The sensor's film, which each pass overwrites."""
        return self.sensor.film()

    def facts(self) -> dict[str, Any]:
        """Return all that the image depends on, for JSON."""
        from manylights import __version__

        width, height = map(int, self.film.crop_size())
        return {
            "version": f"manylights {__version__}, Mitsuba {mi.__version__}",
            "variant": mi.variant(),
            "spp": self.plan.spp,
            "seed": self.seed,
            "sensor": self.index,
            "size": f"{width} x {height}",
            "samples_per_pass": self.plan.samples_per_pass,
            **self.choices,
            "files": _digests(self.loaded.files),
        }


def is_scalar() -> bool:
    """Is the current variant a scalar one?"""
    return mi.variant().startswith("scalar")


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return in words what the facts of two jobs do not share, the old one's value first."""
    changed = [name for name in new if old.get(name) != new[name]]
    changes = [
        f"{name} {_words(old.get(name))} and not {_words(new[name])}"
        for name in changed
        if name != "files"
    ]
    if "files" in changed:
        before, now = old.get("files", {}), new["files"]
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        changes.append(f"another content of {', '.join(names)}")
    return changes


def _digests(paths: list[Path]) -> dict[str, str]:
    """Return SHA-256 of the files by their names, seen from the folder of the first."""
    folder = paths[0].parent if paths else ""
    return {
        os.path.relpath(path, folder): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in dict.fromkeys(paths)
    }


def _words(value: Any) -> str:
    """Return a fact for people: options that are given several times as typed."""
    if isinstance(value, dict):
        return " ".join(f"{name}={item}" for name, item in value.items()) or "none"
    return "none" if value is None else str(value)

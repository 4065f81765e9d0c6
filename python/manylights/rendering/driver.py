"""Has Mitsuba render the steps of a job, and gives their films as arrays.

Nothing here knows about files.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import nullcontext

import mitsuba as mi
import numpy as np

from manylights.errors import UsageError
from manylights.loading import LoadedScene
from manylights.loading.integrators import by_name
from manylights.output import channels
from manylights.rendering.plan import Limits, Step

#: Takes the finished fraction of a step, from 0 to 1; may be called from another thread.
Report = Callable[[float], None]

#: Samplers that can be asked for any sample, by the name of their class.
INDEXED = ("SobolSampler",)

#: Entries of our integrators and of such samplers, as ``mi.traverse`` names them. Those of
#: integrators that others nest are left alone: the others make the passes.
PLAN, COUNTS, FIRST = ENTRIES = "plan", "visibility.counts", "first_sample"


class Driver:
    """Renders one scene with one sensor and one integrator.

    Attributes:
        scene, sensor, integrator: of Mitsuba.
        indexed: can the sampler be asked for any sample?
        plans: does the integrator follow a plan, and learn from it?
        adjoint: are the film's sums already divided by the samples? Tracers of particles do so.
    """

    def __init__(self, loaded: LoadedScene, sensor, integrator=None) -> None:
        self.scene, self.sensor = loaded.scene, sensor
        self.integrator = integrator or self.scene.integrator()
        if self.integrator is None:
            raise UsageError(f"the scene has no integrator, name one{by_name()}")
        self.integrator_count = loaded.integrator_count
        self.indexed = sensor.sampler().class_name() in INDEXED
        self.plans = _has(self.integrator, PLAN)
        self.adjoint = isinstance(self.integrator, mi.AdjointIntegrator)

    def limits(self) -> Limits:
        """Return what the sizes of steps depend on."""
        pixels = int(np.prod(self.sensor.film().crop_size()))
        backend = mi.variant().split("_")[0]
        return Limits(pixels, backend, self.indexed, self.plans)

    def render(self, step: Step, seed: int, spp: int, report: Report) -> np.ndarray:
        """Render a step and return the film's sums, shape (height, width, channels).

        Args:
            step: whose samples are rendered.
            seed: of its sequence.
            spp: samples per pixel of the whole job.
            report: called with the finished fraction of the step.

        Raises:
            UsageError: it was stopped before its end.
        """
        self._follow(step)
        planned = step.passes and self.plans
        spp = spp if planned else step.spp

        def report_blocks(fraction: float) -> None:
            # Our integrators tell the fraction of the whole job.
            done = fraction * spp - step.passes[0].first if planned else fraction * spp
            report(min(max(done / step.spp, 0.0), 1.0))

        blocks = block_progress(self.integrator_count, report_blocks)
        with blocks if mi.variant().startswith("scalar") else nullcontext():
            self.integrator.render(
                self.scene, sensor=self.sensor, seed=seed, spp=spp, develop=False
            )
        raw = np.array(self.sensor.film().develop(raw=True))
        report(1.0)
        # Mitsuba ends a step early after SIGINT also where Python ignores it, as in scripts.
        if self.integrator.should_stop():
            raise UsageError(
                "the render was stopped before its end, by an interrupt or its integrator's timeout"
            )
        return raw * np.float32(step.spp) if self.adjoint else raw

    def blank(self) -> np.ndarray:
        """Return the film's sums before any step: zeros. Makes its channels known."""
        film = self.sensor.film()
        film.prepare(self.integrator.aov_names())
        film.clear()
        return np.array(film.develop(raw=True))

    def end(self) -> None:
        """Leave integrator and sampler as they were: they make their own passes again."""
        if self.plans:
            _write(self.integrator, PLAN, [])
        if self.indexed:
            _write(self.sensor.sampler(), FIRST, 0)

    def learnt(self) -> np.ndarray:
        """Return what has been learnt, as integers; none if nothing."""
        if not self.plans:
            return np.zeros(0, np.uint32)
        return np.array(mi.traverse(self.integrator)[COUNTS], np.uint32)

    def learn(self, counts: np.ndarray) -> None:
        """Go on with what another process has learnt."""
        if self.plans and counts.size:
            _write(self.integrator, COUNTS, counts)

    def channels(self) -> list[str]:
        """Return the names of the film's channels as they are summed, after the first step."""
        return channels.names(self.sensor.film().bitmap(raw=True))

    def shown(self) -> list[str]:
        """Return the names of the channels that the film makes of them for its image."""
        return channels.names(self.sensor.film().bitmap())

    def _follow(self, step: Step) -> None:
        if self.plans:
            plan = [number for one in step.passes for number in (one.first, one.count, one.role, 0)]
            _write(self.integrator, PLAN, plan)
        if self.indexed:
            _write(self.sensor.sampler(), FIRST, step.passes[0].first if step.passes else 0)


def _has(thing, name: str) -> bool:
    return any(name == known for known, _ in mi.traverse(thing))


def _write(thing, name: str, value) -> None:
    """Write an entry: ``parameters[name] = value`` fails for arrays of another size."""
    parameters = mi.traverse(thing)
    pointer, kind, *_ = parameters.properties[name]
    parameters.set_dirty(name)
    parameters.set_property(pointer, kind, type(parameters[name])(value))
    parameters.update()


class block_progress:
    """Context in which the blocks that a scalar variant finishes reach ``report``.

    Mitsuba tells its progress to its log, and only where the log shows messages of level Info, so
    the log's receivers are exchanged for one that drops those messages. Warnings stay visible.
    A nesting integrator renders once for each nested one: ``jobs`` counts them all.
    """

    def __init__(self, jobs: int, report: Report) -> None:
        self.jobs, self.report = jobs, report

    def __enter__(self) -> None:
        self.before = mi.logger()
        logger = mi.Logger(mi.LogLevel.Info)
        logger.set_formatter(self.before.formatter())
        logger.add_appender(_appender(self.jobs, self.report))
        mi.set_logger(logger)

    def __exit__(self, *_) -> None:
        mi.set_logger(self.before)


def _appender(jobs: int, report: Report):
    """Make the log receiver of ``block_progress``."""

    class ProgressAppender(mi.Appender):
        def __init__(self) -> None:
            super().__init__()
            self.done, self.last, self.lock = 0, 0.0, threading.Lock()

        def append(self, level, text) -> None:
            if level >= mi.LogLevel.Warn:
                os.write(2, f"{text}\n".encode())

        def log_progress(self, progress, name, formatted, eta, ptr=None) -> None:
            with self.lock:
                if progress < self.last:
                    self.done += 1
                self.last = progress
                report(min((self.done + progress) / jobs, 1.0))

    return ProgressAppender()

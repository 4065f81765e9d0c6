"""Renders the passes of a job one after the other, and makes an image of their sums.

Nothing here knows about files.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext

import mitsuba as mi
import numpy as np

from manylights.rendering.job import Job, is_scalar
from manylights.rendering.plan import Pass
from manylights.rendering.sums import Sums

#: Takes the finished fraction, from 0 to 1; may be called from another thread.
Report = Callable[[float], None]


def render_passes(job: Job, sums: Sums, report: Report) -> Iterator[Sums]:
    """Render the passes of a job that are not in ``sums``; yield the sums after each of them."""
    for part in job.plan.passes[sums.passes :]:
        sums.add(render_pass(job, part, report))
        yield sums


def develop(film, sums: Sums):
    """Return the film's ``mi.Bitmap`` for these sums, weights divided out."""
    block = mi.ImageBlock(mi.TensorXf(sums.high), film.crop_offset())
    film.clear()
    film.put_block(block)
    return film.bitmap()


def render_pass(job: Job, part: Pass, report: Report) -> np.ndarray:
    """Render one of the passes and return the film's sums."""
    scene, spp = job.loaded.scene, job.plan.spp
    integrator = scene.integrator()

    def report_block(fraction: float) -> None:
        report((part.begin + fraction * part.spp) / spp)

    blocks = block_progress(job.loaded.integrator_count, report_block)
    with blocks if is_scalar() else nullcontext():
        integrator.render(scene, sensor=job.sensor, seed=part.seed, spp=part.spp, develop=False)
    raw = np.array(job.film.develop(raw=True))
    report((part.begin + part.spp) / spp)
    # Tracers of particles divide by their samples and leave the film's weights at zero.
    return raw * (part.spp / spp) if isinstance(integrator, mi.AdjointIntegrator) else raw


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

"""Renders a loaded scene, in passes where that is useful, and reports the progress.

What an image is made of depends only on the scene, the variant, the number of samples and the seed:

- scalar variants render all samples in one go and report each finished block;
- JIT variants render long jobs in passes of ``pass_sizes()`` samples. Pass 0 uses the seed itself,
  pass k a number derived from the seed and k. The film's sums of all passes are added before the
  division by the filter weights, so each sample has the same weight, whatever its pass.

A stratified sampler stratifies within a pass; that is why there are few passes.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

import mitsuba as mi
import numpy as np

from manylights.errors import UsageError
from manylights.loading import LoadedScene
from manylights.threads import thread_count

#: Samples of one pass in JIT variants, at most: they bound the memory for the samplers' states
#: (16 bytes and more for each sample) and the wait for the next step of the bar.
MAX_SAMPLES_PER_PASS = 2**24

#: Renders up to this many samples take seconds and are one pass, the same as ``mi.render``.
SINGLE_PASS_SAMPLES = 2**22

#: Passes of a longer render, at least: enough for a bar, few enough for stratification.
MIN_PASSES = 4

Report = Callable[[float], None]


def pass_sizes(spp: int, pixels: int) -> list[int]:
    """Split ``spp`` samples per pixel into the passes of a JIT render.

    Up to ``SINGLE_PASS_SAMPLES`` samples of the whole image are one pass. Above, all passes have
    the same power of two and the last one takes the rest: equal passes share one compiled kernel,
    and powers of two suit the stratified samplers.

    >>> pass_sizes(16, 640 * 360)
    [16]
    >>> pass_sizes(72, 640 * 360)
    [16, 16, 16, 16, 8]
    """
    if spp * pixels <= SINGLE_PASS_SAMPLES:
        return [spp]
    largest = max(1, min(spp // MIN_PASSES, MAX_SAMPLES_PER_PASS // pixels))
    size = 1 << (largest.bit_length() - 1)
    sizes = [size] * (spp // size)
    rest = spp - sum(sizes)
    return [*sizes, rest] if rest else sizes


def pass_seed(seed: int, index: int) -> int:
    """Return the seed of pass ``index``, 32 bits: ``seed`` for pass 0, else derived from both."""
    if index == 0:
        return seed
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def render(
    loaded: LoadedScene,
    sensor: int,
    spp: int,
    seed: int,
    report: Report,
    threads: int | None = None,
):
    """Render and return the film's ``mi.Bitmap`` with all its channels, weights divided out.

    Args:
        loaded: what ``load`` returned.
        sensor: index of the sensor.
        spp: samples per pixel, >= 1, or 0 for what the scene's sampler says.
        seed: of the random numbers, 0 to 2^32 - 1.
        report: called with the finished fraction, from 0 to 1; may come from another thread.
        threads: CPU threads of the render, >= 1, or ``None`` for what Mitsuba has set.

    Raises:
        UsageError: there is no such sensor.
    """
    sensors = loaded.scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise UsageError(f"--sensor {sensor}: the scene has {len(sensors)}, counted from 0")
    chosen = sensors[sensor]
    spp = spp or chosen.sampler().sample_count()
    work = _render_blocks if mi.variant().startswith("scalar") else _render_passes
    with thread_count(threads):
        work(loaded, chosen, spp, seed, report)
    return chosen.film().bitmap()


def _render_blocks(loaded: LoadedScene, sensor, spp: int, seed: int, report: Report) -> None:
    with block_progress(loaded.integrator_count, report):
        loaded.scene.integrator().render(
            loaded.scene, sensor=sensor, seed=seed, spp=spp, develop=False
        )


def _render_passes(loaded: LoadedScene, sensor, spp: int, seed: int, report: Report) -> None:
    film = sensor.film()
    sizes = pass_sizes(spp, int(np.prod(film.crop_size())))
    total = None
    for index, size in enumerate(sizes):
        loaded.scene.integrator().render(
            loaded.scene, sensor=sensor, seed=pass_seed(seed, index), spp=size, develop=False
        )
        raw = np.array(film.develop(raw=True), dtype=np.float64)
        total = raw if total is None else total + raw
        report(sum(sizes[: index + 1]) / spp)
    block = mi.ImageBlock(mi.TensorXf(total.astype(np.float32)), film.crop_offset())
    film.clear()
    film.put_block(block)


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

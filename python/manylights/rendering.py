"""Renders a loaded scene, in passes where that is useful, and reports the progress.

What an image is made of depends only on the scene, the variant, the number of samples and the seed,
and in scalar variants on whether checkpoints are kept, never on time:

- scalar variants without checkpoints render all samples in one pass;
- all others render long jobs in passes of ``pass_sizes()`` samples. Each has a seed of its own. The
  film's sums of all passes are added before the division by the filter weights, so each sample has
  the same weight, whatever its pass.

A stratified sampler stratifies within a pass; that is why there are few passes.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from manylights.errors import UsageError
from manylights.loading import LoadedScene
from manylights.threads import thread_count

if TYPE_CHECKING:
    from manylights.checkpoint import Checkpoint

#: Samples of one pass in JIT variants, at most: they bound the memory for the samplers' states
#: (16 bytes and more for each sample) and the wait for the next step of the bar.
MAX_SAMPLES_PER_PASS = 2**24

#: The same in scalar variants, where they take ten seconds to a minute on two cores. Where that is
#: too little for samplers to stratify, passes have a few samples per pixel.
MAX_SAMPLES_PER_SCALAR_PASS, MIN_SCALAR_SPP = 2**22, 4

#: Renders up to this many samples take seconds and are one pass, the same as ``mi.render``.
SINGLE_PASS_SAMPLES = 2**22

#: Passes of a longer render, at least: enough for a bar, few enough for stratification.
MIN_PASSES = 4

Report = Callable[[float], None]


class Sums:
    """The film's sums over passes, each number kept as two in single precision.

    Together they have 48 bits, so that long renders lose nothing, and files can hold them as they
    are: a render that goes on from a file computes with the same bits as one that never stopped.

    Attributes:
        passes: how many were added.
        high: the sums, rounded to single precision; shape (height, width, channels).
        low: what the rounding left over.
    """

    def __init__(self, passes: int = 0, high=0.0, low=0.0) -> None:
        self.passes, self.high, self.low = passes, high, low

    def add(self, raw: np.ndarray) -> None:
        """Add the raw film of a pass."""
        # Channels may be infinite; nothing is left over of those.
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.low + raw.astype(np.float64) + self.high
            self.high = total.astype(np.float32)
            rest = total - self.high
            self.low = np.where(np.isfinite(rest), rest, 0.0).astype(np.float32)
        self.passes += 1


def pass_sizes(spp: int, pixels: int, most: int = MAX_SAMPLES_PER_PASS) -> list[int]:
    """Split ``spp`` samples per pixel into passes of ``most`` samples of the whole image, at most.

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
    largest = max(1, min(spp // MIN_PASSES, most // pixels))
    size = 1 << (largest.bit_length() - 1)
    sizes = [size] * (spp // size)
    rest = spp - sum(sizes)
    return [*sizes, rest] if rest else sizes


def checkpointed_sizes(film, spp: int) -> list[int]:
    """Return the samples per pixel of each pass of a render that keeps checkpoints."""
    pixels, most = int(np.prod(film.crop_size())), MAX_SAMPLES_PER_PASS
    if _is_scalar():
        most = max(MAX_SAMPLES_PER_SCALAR_PASS, MIN_SCALAR_SPP * pixels)
    return pass_sizes(spp, pixels, most)


def pass_seed(seed: int, index: int) -> int:
    """Return the seed of pass ``index``, 32 bits: ``seed`` for pass 0.

    They are an odd number apart. Scalar variants use the product with the number of pixels, modulo
    2^32, which is one of 4096 numbers for 1024 x 1024 pixels: seeds drawn at random would repeat a
    pass there. The distance depends on the seed, so that two renders share no passes.
    """
    distance = int(np.random.SeedSequence(seed).generate_state(1)[0]) | 1
    return (seed + index * distance) % 2**32


def resolve(loaded: LoadedScene, sensor: int, spp: int) -> tuple:
    """Return the sensor of this index and the samples per pixel, the sampler's own for 0.

    Raises:
        UsageError: there is no such sensor.
    """
    sensors = loaded.scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise UsageError(f"--sensor {sensor}: the scene has {len(sensors)}, counted from 0")
    chosen = sensors[sensor]
    return chosen, spp or chosen.sampler().sample_count()


def render(
    loaded: LoadedScene,
    sensor: int,
    spp: int,
    seed: int,
    report: Report,
    threads: int | None = None,
    checkpoint: Checkpoint | None = None,
):
    """Render and return the film's ``mi.Bitmap`` with all its channels, weights divided out.

    Args:
        loaded: what ``load`` returned.
        sensor: index of the sensor.
        spp: samples per pixel, >= 1, or 0 for what the scene's sampler says.
        seed: of the random numbers, 0 to 2^32 - 1.
        report: called with the finished fraction, from 0 to 1; may come from another thread.
        threads: CPU threads of the render, >= 1, or ``None`` for what Mitsuba has set.
        checkpoint: what to go on from, and where to keep the state. Default: nothing is kept.

    Raises:
        UsageError: there is no such sensor.
    """
    chosen, spp = resolve(loaded, sensor, spp)
    film = chosen.film()
    split = checkpoint is not None or not _is_scalar()
    sizes = checkpointed_sizes(film, spp) if split else [spp]
    sums = Sums() if checkpoint is None else checkpoint.sums
    with thread_count(threads):
        while sums.passes < len(sizes):
            sums.add(_render_pass(loaded, chosen, sizes, sums.passes, seed, report))
            if checkpoint is not None and sums.passes < len(sizes):
                checkpoint.keep(film)
    return develop(film, sums)


def develop(film, sums: Sums):
    """Return the film's ``mi.Bitmap`` for these sums, weights divided out."""
    block = mi.ImageBlock(mi.TensorXf(sums.high), film.crop_offset())
    film.clear()
    film.put_block(block)
    return film.bitmap()


def _is_scalar() -> bool:
    return mi.variant().startswith("scalar")


def _render_pass(
    loaded: LoadedScene, sensor, sizes: list[int], index: int, seed: int, report: Report
) -> np.ndarray:
    """Render one of the passes and return the film's sums."""
    scene, size = loaded.scene, sizes[index]
    integrator, spp, before = scene.integrator(), sum(sizes), sum(sizes[:index])

    def report_block(fraction: float) -> None:
        report((before + fraction * size) / spp)

    blocks = block_progress(loaded.integrator_count, report_block)
    with blocks if _is_scalar() else nullcontext():
        integrator.render(
            scene, sensor=sensor, seed=pass_seed(seed, index), spp=size, develop=False
        )
    raw = np.array(sensor.film().develop(raw=True))
    report((before + size) / spp)
    # Tracers of particles divide by their samples and leave the film's weights at zero.
    return raw * (size / spp) if isinstance(integrator, mi.AdjointIntegrator) else raw


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

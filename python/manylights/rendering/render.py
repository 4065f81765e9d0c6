"""Renders a job: step by step, with its state in a file if that is wanted.

Visibility of lights is learnt once, in the first step. How many samples a noise needs is predicted,
from four independent images that are rendered in turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from manylights import files, loading
from manylights.errors import UsageError, check, integer, number
from manylights.output import channels, images
from manylights.rendering import checkpoint as checkpoints
from manylights.rendering import metadata, state_file
from manylights.rendering.arguments import check_together
from manylights.rendering.checkpoint import Checkpoint
from manylights.rendering.develop import develop
from manylights.rendering.extras import Extras
from manylights.rendering.job import Job
from manylights.rendering.parts import Part
from manylights.rendering.state import State
from manylights.threads import MOST_THREADS, thread_count


@dataclass
class Progress:
    """How far a render is.

    Attributes:
        fraction: of what is to be done, as far as is known, from 0 to 1.
        samples: per pixel, those that are done.
        seconds: that they took, those of interrupted processes, too.
        noise: relative, of the last round; None if it is not known.
        kept: what the checkpoint holds, in words; None without or before the first.
        workers: lines about what each of them does.
    """

    fraction: float
    samples: int
    seconds: float
    noise: float | None = None
    kept: str | None = None
    workers: list[str] = field(default_factory=list)


@dataclass
class RenderResult:
    """An image, and what is known about it.

    Attributes:
        image: shape (height, width, channels), single precision, as ``mi.render`` returns it,
            multiplied by the exposure of a USD camera.
        bitmap: the same as ``mi.Bitmap``, with names; the file has the film's number format.
        variance: of each pixel's mean, shape (height, width, colours), in squared units of the
            image; None if it is not known: only renders with a target find it.
        noise: the root of the mean relative variance of the pixels, without the largest 0.1 % of
            them: 0.02 is 2 %. None if it is not known.
        samples: per pixel.
        seconds: of rendering, those of interrupted processes, too.
        notes: lines about what was replaced, left out or not reached.
        files: that were written.
        denoised: the colours without noise, shape (height, width, 3 or 1); None if that was not
            asked for.
    """

    image: np.ndarray
    bitmap: Any
    variance: np.ndarray | None
    noise: float | None
    samples: int
    seconds: float
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    denoised: np.ndarray | None = None


def render(
    scene,
    *,
    spp: int | None = None,
    seed: int = 0,
    sensor: int = 0,
    integrator=None,
    until_noise: float | None = None,
    seconds: float | None = None,
    output: str | Path | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_seconds: float = 60.0,
    part: tuple[int, int] | Part | None = None,
    learnt: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    threads: int | None = None,
    client=None,
    ship: bool = False,
    **extras: Any,
) -> RenderResult:
    """Render a scene: a number of samples, or until an image is good enough or a time is up.

    The same scene, variant, samples and seed give the same bits, with any number of threads and
    however often it was interrupted; so does ``until_noise``. The current variant is used.

    Args:
        scene: path of an XML file or a USD stage, a dictionary as for ``mi.load_dict``, an
            ``mi.Scene``, or what ``manylights.loading.load`` returned. Of files and dictionaries
            ``direct``, ``path``, ``volpath`` and ``independent`` are replaced by ours.
        spp: samples per pixel, with a target the most. Default: the sampler's, or 65536.
        seed: of the random numbers, 0 to 4294967295.
        sensor: index of the sensor, from 0.
        integrator: ``None`` for the choice above, ``"keep"`` for the scene's own, the name of a
            plugin, a dictionary of a plugin and its parameters, or an ``mi.Integrator``.
        until_noise: render until ``RenderResult.noise`` is this, above 0: 0.02 is 2 %.
        seconds: render for so long, above 0. The last step may end later, by its length or 5 %.
        output: file (.exr) to write the image to, with a PNG beside it. Default: none.
        checkpoint: file (.exr) of the state, to go on from another time. Removed at the end.
        checkpoint_seconds: at least between two writings of it.
        part: ``(3, 16)`` renders a share of the steps, to OUT.part-03-of-16.exr. Default: all.
        learnt: file of another part, to take over what is learnt. Default: learn it anew.
        progress: called now and then, also from other threads. What it raises ends the render.
        threads: CPU threads, 1 or more. Default: all, on workers those that Dask knows of.
        client: ``distributed.Client``, whose workers render the scene of a file. Default: none.
        ship: send them the files? Default: the workers have these at the same path.
        extras: ``aovs``, ``light_groups``, ``denoise``, ``exposure``, ``tev``: those of ``Extras``.

    Raises:
        UsageError: (a ``ValueError``) impossible values, files of another render, no worker of use.
        RuntimeError: Mitsuba or a worker cannot read or render the scene.
    """
    target = None if output is None else images.check_output(str(output))
    part, wanted = Part.of(part), Extras.of(extras, part)
    check_together(part, until_noise, seconds, learnt, client, ship)
    loaded, own = loading.as_loaded(scene, integrator, wanted.parameters())
    job = Job.of(loaded, sensor, spp, seed, until_noise, seconds, own, part)
    store = None if checkpoint is None else _store(checkpoint, job, checkpoint_seconds)
    facts, state = _begin(job, store, target, learnt)
    _work(job, state, store, facts, progress, wanted.prepare(job, target), threads, client, ship)
    return _finished(job, state, store, facts, target, wanted)


def _check_apart(target: Path | None, job: Job) -> None:
    """Check that neither the image nor its preview is a file of the scene, a texture as a rule."""
    if target is not None:
        path = target if job.part is None else part_path(target, job.part)
        for written in (path, path.with_suffix(".png")):
            files.check_apart(written, job.loaded.files)


def _begin(job: Job, store, target: Path | None, learnt) -> tuple[dict[str, Any], State]:
    """Return the facts that files need, and the state that the render goes on from."""
    _check_apart(target, job)
    # Before the render, which may change the scene's parameters.
    facts = store.facts if store else job.facts() if target or learnt else {}
    state = (store and store.restore()) or State.empty(job.course.sequences)
    if learnt is not None and not state.learnt.size:
        state.learnt = checkpoints.learnt(files.path_of("learnt", learnt), job, facts)
    return facts, state


def _work(job: Job, state: State, store, facts, progress, watch, threads, client, ship) -> None:
    """Render what the state does not have, here or with workers."""
    progress = progress or (lambda _: None)
    check("progress", progress, callable(progress), "a function")
    threads = None if threads is None else integer("threads", threads, 1, MOST_THREADS)
    if client is None:
        with thread_count(threads):
            run(job, state, store, progress, watch=watch)
        return
    from manylights.rendering import workers

    watched = state.history.steps

    def report(begun: float, spent: float, lines: list[str]) -> None:
        nonlocal watched
        progress(replace(_progress(job, state, store, begun, spent), workers=lines))
        if watch is not None and watched != state.history.steps:
            watched = state.history.steps
            watch(state)

    workers.run(job, state, store, facts or job.facts(), client, report, threads, ship)


def part_path(target: str | Path, part: Part) -> Path:
    """Return where a part of an image is: beside it, ``OUT.part-03-of-16.exr``."""
    return Path(target).with_suffix(f".{part.name()}.exr")


def _finished(
    job: Job, state: State, store, facts: dict, target: Path | None, wanted: Extras
) -> RenderResult:
    result = result_of(job, state)
    wanted.add_denoised(job, result)
    if target is not None and job.part is not None:
        path = part_path(target, job.part)
        Checkpoint(path, job, facts=facts).write(state)
        result.files = [path]
    elif target is not None:
        signed = state_file.signature({**facts, "seeds": [job.seed]}, result.samples)
        layers = {**variance_layers(result)}
        layers |= channels.color_layers(channels.DENOISED, result.denoised)
        attributes = signed | metadata.attributes(job, result, facts["version"])
        number = images.number_of(job.film)
        result.files, notes = images.write_images(
            result.bitmap,
            target,
            layers,
            attributes,
            number,
            result.samples,
            result.denoised,
            wanted.exposure,
        )
        result.notes += notes
    if store is not None and not any(files.is_same(store.path, file) for file in result.files):
        store.remove()
    return result


def variance_layers(result: RenderResult) -> dict[str, np.ndarray]:
    """Return the channels ``variance.*``, where the variance is known."""
    return channels.color_layers(channels.VARIANCE, result.variance)


def _store(path: str | Path, job: Job, seconds: float) -> Checkpoint:
    seconds = number("checkpoint_seconds", seconds, lambda value: value > 0.0, "a number above 0")
    path = files.path_of("checkpoint", path)
    if path.suffix.lower() != ".exr":
        raise UsageError(f"checkpoint {path}: it is an OpenEXR file, end the name in .exr")
    if not path.parent.is_dir():
        raise UsageError(f"checkpoint {path}: there is no folder {path.parent}")
    return Checkpoint(path, job, seconds)


def run(
    job: Job,
    state: State,
    store: Checkpoint | None,
    progress: Callable[[Progress], None],
    clock: Callable[[], float] = time.perf_counter,
    watch: Callable[[State], None] | None = None,
) -> None:
    """Render the steps of a job that the state does not have, and add them to it.

    Args:
        job, state: what is rendered.
        store: keeps the state.
        progress: called with how far it is.
        clock: for tests.
        watch: called with the state after each step; its time does not count.
    """
    history, driver = state.history, job.driver

    def tell(fraction_of_step: float = 0.0, spp: int = 0) -> None:
        spent = clock() - start
        progress(_progress(job, state, store, fraction_of_step * spp, spent))

    start, begun = clock(), history.steps
    tell()
    driver.learn(state.learnt)
    try:
        _learn(job, state)
        history.seconds += clock() - start
        while (step := job.course.next_step(history)) is not None:
            start = clock()
            raw = job.render(step, lambda done: tell(done, step.spp))
            state.channels = state.channels or driver.channels()
            state.add(step, raw, clock() - start)
            if job.course.round_is_complete(history):
                state.end_round(driver.adjoint)
            # What the sums took is part of the time, too.
            history.add_seconds(clock() - start - history.last_seconds)
            start = clock()
            if store is not None and job.course.next_step(history) is not None:
                state.learnt = driver.learnt()
                store.keep(state)
            history.seconds += clock() - start
            if watch is not None:
                watch(state)
            start = clock()
            tell()
        state.learnt = driver.learnt()
    finally:
        driver.end()
    if history.steps == begun:
        job.add_nothing(state)


def _learn(job: Job, state: State) -> None:
    """Learn what the first step teaches, if this part does not have it."""
    step = job.course.training(state.history)
    if step is not None and not state.learnt.size:
        job.render(step)


def result_of(job: Job, state: State) -> RenderResult:
    """Return the image of a state. The scene's film holds it then."""
    driver, exposure = job.driver, job.loaded.exposure
    image, bitmap = develop(job.film, state.total(driver.adjoint), exposure)
    spread = state.spread(driver.adjoint)
    noise = None if spread is None else spread.noise
    variance = None if spread is None else spread.variance * np.float32(exposure**2)
    history, notes = state.history, job.loaded.notes + job.notes(state.history, noise)
    return RenderResult(image, bitmap, variance, noise, history.spp, history.seconds, notes)


def _progress(job: Job, state: State, store, begun: float, spent: float) -> Progress:
    """Return how far a render is with some samples of a step and some seconds of it."""
    history, course = state.history, job.course
    seconds = history.seconds + spent
    predicted = course.predicted_spp(history.noises)
    fraction = (history.spp + begun) / predicted if predicted else 1.0
    if course.seconds is not None:
        fraction = max(fraction, seconds / course.seconds)
    noise = history.noises[-1] if history.noises else None
    kept = store.describe() if store is not None else None
    return Progress(min(fraction, 1.0), history.spp, seconds, noise, kept)

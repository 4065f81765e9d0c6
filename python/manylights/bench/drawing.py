"""One render: the picture as an array, and what it took."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.bench.scene_source import MeasuredScene
from manylights.errors import UsageError
from manylights.output import channels, denoise
from manylights.rendering import plan as plans

#: Channels of a pixel that are colours, by the number of channels: with or without alpha.
COLORS = {1: 1, 2: 1, 3: 3, 4: 3}


class BrokenImage(Exception):
    """A render gave pixels that are no numbers."""


@dataclass
class Drawing:
    """A picture, shape (height, width, 3), and the seconds of clock and of all CPUs together."""

    image: np.ndarray
    seconds: float
    cpu_seconds: float


def draw(loaded: MeasuredScene, integrator, spp: int, seed: int, sampler: str) -> Drawing:
    """Render a scene and measure how long that takes, until the pixels are in memory.

    Args:
        loaded: the scene.
        integrator: what ``mi.load_dict`` returned.
        spp: samples per pixel, at least 1.
        seed: of the random numbers.
        sampler: one that the scene has.

    Raises:
        BrokenImage: a pixel is infinite or not a number.
        UsageError: the film has no colours.
    """
    start, cpu_start = time.perf_counter(), time.process_time()
    pixels = _render(loaded, integrator, spp, seed, sampler)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    image = _colors(pixels)
    _check(image, spp, seed)
    return Drawing(image, seconds, cpu_seconds)


def draw_denoised(loaded: MeasuredScene, integrator, spp: int, seed: int, sampler: str) -> Drawing:
    """Render a scene with what the denoiser wants to know, and denoise that: as ``draw``.

    Args:
        loaded: the scene.
        integrator: of a dictionary of ``methods.with_guides``.
        spp: samples per pixel, at least 1.
        seed: of the random numbers.
        sampler: one that the scene has.
    """
    start, cpu_start = time.perf_counter(), time.process_time()
    pixels = _render(loaded, integrator, spp, seed, sampler)
    guides = len(denoise.GUIDES) * 3
    # What Mitsuba's aov nests has as many channels as the image, whatever their names.
    nested = f"{denoise.EMISSION}.A" in integrator.aov_names()
    count = (pixels.shape[2] - guides) // 2 if nested else pixels.shape[2] - guides - 3
    colors, emission = _colors(pixels[..., :count]), _colors(pixels[..., count:-guides])
    _check(colors, spp, seed)
    names = [f"{denoise.EMISSION}.{letter}" for letter in channels.RGB]
    names = [*channels.RGB, *names, *integrator.aov_names()[-guides:]]
    guided = np.concatenate([colors, emission, pixels[..., -guides:]], axis=2)
    image = denoise.denoised(guided, names)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    return Drawing(image, seconds, cpu_seconds)


def draw_channels(
    loaded: MeasuredScene, integrator, spp: int, seed: int, names: tuple[str, ...]
) -> np.ndarray:
    """Render a scene and return those channels that the integrator adds under these names."""
    pixels = np.array(integrator.render(loaded.scene, sensor=0, seed=seed, spp=spp))
    added = integrator.aov_names()
    return pixels[..., [added.index(name) - len(added) for name in names]]


def _render(loaded: MeasuredScene, integrator, spp: int, seed: int, sampler: str) -> np.ndarray:
    """Render in as many passes as the memory needs; each sample has the same weight."""
    width, height = loaded.size
    total: Any = 0.0
    backend = mi.variant().split("_")[0]
    sensor = loaded.sensors[sampler]
    if backend == "scalar" or spp * width * height <= plans.MOST_STATES:
        return np.array(integrator.render(loaded.scene, sensor, seed, spp))
    limits = plans.Limits(width * height, backend, indexed=False, learns=False)
    for step in plans.steps(spp, limits):
        number = plans.seed_of(seed, step.index)
        pixels = integrator.render(loaded.scene, sensor, number, step.spp)
        total = total + np.array(pixels) * (step.spp / spp)
    return total


def _check(image: np.ndarray, spp: int, seed: int) -> None:
    broken = int(np.sum(~np.isfinite(image).all(axis=2)))
    if broken:
        raise BrokenImage(f"{broken} pixels are not finite at {spp} spp with seed {seed}")


def _colors(pixels: np.ndarray) -> np.ndarray:
    colors = COLORS.get(pixels.shape[2])
    if colors is None:
        raise UsageError(f"the film has {pixels.shape[2]} channels, not luminance or RGB")
    return np.broadcast_to(pixels[..., :colors], (*pixels.shape[:2], 3)).astype(np.float32)

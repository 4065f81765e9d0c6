"""Loads and renders a scene in passes, reports progress, and writes the image files.

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
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from manylights import integrators
from manylights.errors import UsageError

#: Samples of one pass in JIT variants, at most: they bound the memory for the samplers' states
#: (16 bytes and more for each sample) and the wait for the next step of the bar.
MAX_SAMPLES_PER_PASS = 2**24

#: Renders up to this many samples take seconds and are one pass, the same as ``mi.render``.
SINGLE_PASS_SAMPLES = 2**22

#: Passes of a longer render, at least: enough for a bar, few enough for stratification.
MIN_PASSES = 4

Report = Callable[[float], None]


@dataclass
class LoadedScene:
    """A scene, how many integrators it nests, and what was said about choosing them."""

    scene: object
    integrator_count: int
    notes: list[str]


def default_variant() -> str:
    """Return ``llvm_ad_rgb`` where libLLVM is installed, else ``scalar_rgb``."""
    has_llvm = "llvm_ad_rgb" in mi.variants() and dr.has_backend(dr.JitBackend.LLVM)
    return "llvm_ad_rgb" if has_llvm else "scalar_rgb"


def set_variant(name: str | None) -> str:
    """Set Mitsuba's variant, ``None`` for the default one, and return its name.

    Raises:
        UsageError: Mitsuba does not have it, or the machine lacks LLVM or CUDA.
    """
    variant = name or default_variant()
    if variant not in mi.variants():
        raise UsageError(f"--variant {variant}: unknown, choose from {', '.join(mi.variants())}")
    for prefix, backend in (("llvm", dr.JitBackend.LLVM), ("cuda", dr.JitBackend.CUDA)):
        if variant.startswith(prefix) and not dr.has_backend(backend):
            raise UsageError(
                f"--variant {variant}: this machine has no usable {prefix.upper()} library, "
                "use a scalar variant or install it"
            )
    mi.set_variant(variant)
    return variant


def parse(path: str, defines: dict[str, str]):
    """Parse an XML scene into ``(config, state)`` of ``mi.parser``, upgraded, not transformed.

    Args:
        path: the XML file.
        defines: values for the scene's ``<default>`` parameters, by name.

    Raises:
        UsageError: there is no such file.
        RuntimeError: Mitsuba cannot read it.
    """
    if not Path(path).is_file():
        raise UsageError(f"{path}: no such file")
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_file(config, str(path), **defines)
    mi.parser.transform_upgrade(config, state)
    return config, state


def instantiate(config, state):
    """Make Mitsuba's objects of a parsed scene.

    Raises:
        UsageError: the file describes something that is not a scene.
    """
    mi.parser.transform_resolve(config, state)
    if config.merge_equivalent:
        mi.parser.transform_merge_equivalent(config, state)
    if config.merge_meshes:
        mi.parser.transform_merge_meshes(config, state)
    scene = mi.parser.instantiate(config, state)
    if not isinstance(scene, mi.Scene):
        raise UsageError("the file holds no <scene>")
    return scene


class search_beside:
    """Context in which Mitsuba looks for a scene's files in the folder of ``path`` first."""

    def __init__(self, path: str) -> None:
        self.folder = str(Path(path).resolve().parent)

    def __enter__(self) -> None:
        self.before = mi.file_resolver()
        resolver = type(self.before)(self.before)
        resolver.prepend(self.folder)
        mi.set_file_resolver(resolver)

    def __exit__(self, *_) -> None:
        mi.set_file_resolver(self.before)


def load(
    path: str,
    defines: dict[str, str] | None = None,
    integrator: str | None = None,
    settings: dict | None = None,
) -> LoadedScene:
    """Load an XML scene and choose its integrator (see ``integrators.choose``).

    Args:
        path: the XML file.
        defines: values for the scene's ``<default>`` parameters. Default: none.
        integrator: ``None`` (``direct`` becomes ours), ``"keep"`` or a plugin's name.
        settings: parameters to set on the integrator. Default: none.
    """
    with search_beside(path):
        config, state = parse(path, defines or {})
        notes = integrators.choose(state, integrator, settings or {})
        count = sum(node.type == mi.ObjectType.Integrator for node in state.nodes)
        return LoadedScene(instantiate(config, state), max(count, 1), notes)


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


def render(loaded: LoadedScene, sensor: int, spp: int, seed: int, report: Report):
    """Render and return the film's ``mi.Bitmap`` with all its channels, weights divided out.

    Args:
        loaded: what ``load`` returned.
        sensor: index of the sensor.
        spp: samples per pixel, >= 1, or 0 for what the scene's sampler says.
        seed: of the random numbers, 0 to 2^32 - 1.
        report: called with the finished fraction, from 0 to 1; may come from another thread.

    Raises:
        UsageError: there is no such sensor.
    """
    sensors = loaded.scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise UsageError(f"--sensor {sensor}: the scene has {len(sensors)}, counted from 0")
    chosen = sensors[sensor]
    spp = spp or chosen.sampler().sample_count()
    if mi.variant().startswith("scalar"):
        _render_blocks(loaded, chosen, spp, seed, report)
    else:
        _render_passes(loaded, chosen, spp, seed, report)
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


def check_output(path: str) -> Path:
    """Return ``path`` if an EXR file can be written there.

    Raises:
        UsageError: another ending, no such folder, a folder of that name, or no permission.
    """
    target = Path(path)
    if target.suffix.lower() != ".exr":
        raise UsageError(f"-o {path}: the image is an OpenEXR file, end the name in .exr")
    if not target.parent.is_dir():
        raise UsageError(f"-o {path}: there is no folder {target.parent}")
    if target.is_dir() or not os.access(target.parent, os.W_OK):
        raise UsageError(f"-o {path}: not writable")
    return target


def write_images(bitmap, target: Path) -> tuple[list[Path], list[str]]:
    """Write ``bitmap`` as EXR to ``target`` and as PNG (8 bits, sRGB) beside it.

    Each file is written under another name first and then renamed, so it is there whole or not
    at all.

    Returns:
        The written files, and lines for the log about what could not be written.
    """
    written, notes = [_write(bitmap, target, mi.Bitmap.FileFormat.OpenEXR)], []
    preview = _preview(bitmap)
    if preview is None:
        notes.append("preview: the film has no colour channels, no PNG written")
    else:
        file_format = mi.Bitmap.FileFormat.PNG
        written.append(_write(preview, target.with_suffix(".png"), file_format))
    return written, notes


def _preview(bitmap):
    """Return an 8-bit sRGB version of the colour channels, None if there are none."""
    formats = mi.Bitmap.PixelFormat
    if bitmap.pixel_format() == formats.MultiChannel:
        bitmap = dict(bitmap.split()).get("<root>", bitmap)
    if bitmap.pixel_format() == formats.MultiChannel:
        return None
    return bitmap.convert(formats.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)


def _write(bitmap, target: Path, file_format) -> Path:
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        bitmap.write(str(partial), file_format)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)
    return target

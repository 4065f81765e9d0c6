"""Adds parts of a render, and means of finished renders that differ in the seed.

The scene is not needed: the files say how the film makes its image of the sums.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.errors import UsageError, check, typed
from manylights.output import channels, images, light_groups
from manylights.output import denoise as denoising
from manylights.rendering import metadata, state_file
from manylights.rendering.develop import WEIGHT, develop
from manylights.rendering.job import FILMS, STATE, differences
from manylights.rendering.parts import gaps, steps_of
from manylights.rendering.state import State
from manylights.rendering.state_file import Saved
from manylights.threads import require_variant

#: Formats of pixels by the channels of an image, those of the integrator left out.
FORMATS = {
    ("Y",): "luminance",
    ("Y", "A"): "luminance_alpha",
    ("R", "G", "B"): "rgb",
    ("R", "G", "B", "A"): "rgba",
    ("X", "Y", "Z"): "xyz",
    ("X", "Y", "Z", "A"): "xyza",
}

#: The part of files that have several.
MERGED = "merged"

WHAT = "part or image"


@dataclass
class Merged:
    """An image of parts or of finished renders.

    Attributes:
        bitmap: ``mi.Bitmap``, with names of channels.
        samples: per pixel.
        missing: what is not there, in words; empty if all is.
        notes: lines for people.
        files: that were written.
    """

    bitmap: Any
    samples: int
    missing: str
    notes: list[str]
    files: list[Path] = field(default_factory=list)


def merge(
    paths: Iterable[str | Path],
    output: str | Path | None = None,
    partial: bool = False,
    denoise: bool = False,
    exposure: float = 0.0,
) -> Merged:
    """Add parts of one render, in any order and grouping, or average renders of several seeds.

    All parts together give the bits of the render that was not parted. Of finished images the mean
    is taken, in double precision, weighted by samples. The file says what all of them say, of the
    camera, too.

    Args:
        paths: files that ``render(..., part=...)``, a checkpoint or an earlier merging wrote, or
            finished images that differ in the seed and the number of samples alone.
        output: file (.exr) to write the image to, with a PNG beside it. Default: none.
        partial: also if parts are missing: the output keeps the sums then, and can be merged again.
        denoise: find the image without noise, too, as ``render`` does; with albedo and normals if
            the files have them. Not of an image that has parts missing.
        exposure: stops by which the PNG is brighter, from -64 to 64.

    Raises:
        UsageError: (a ``ValueError``) a file that cannot be read or is of another render, a part
            that comes twice, one that is missing and ``partial`` is not set, or the output.
        RuntimeError: no variant of Mitsuba is set.
    """
    require_variant()
    target = None if output is None else images.check_output(str(output))
    images.check_stops(exposure)
    if denoise:
        denoising.check_installed()
    listed = isinstance(paths, Iterable) and not isinstance(paths, (str, bytes))
    check("paths", paths, listed, "a list of paths")
    paths = [files.path_of("paths", path) for path in paths]
    if not paths:
        raise UsageError("nothing to merge: no files")
    if target is not None:
        files.check_apart(target, paths)
    first, bitmap = state_file.read(paths[0], WHAT, "")
    if first.state is None:
        return _merge_images(first, bitmap, paths[1:], target, denoise, exposure)
    del bitmap
    total = _Parts(first)
    for path in paths[1:]:
        total.add(state_file.read(path, WHAT, "")[0])
    return total.finish(target, partial, denoise, exposure)


class _Parts:
    """Sums of several files of one render."""

    def __init__(self, first: Saved) -> None:
        self.first, self.facts = first, first.facts
        self.files = [first]
        if self.facts["step_count"] is None:
            raise UsageError(
                f"{first.path}: of a render with a target, whose steps depend on each other"
            )
        self.steps = self.facts["step_count"]
        # The files' runs are kept, their sums are not.
        self.state, first.state = first.state, None
        self.state.history.ahead = []
        self.times = np.zeros(self.steps, np.uint32)
        self._count_steps(first)

    def add(self, saved: Saved) -> None:
        """Add another file."""
        if saved.state is None:
            raise UsageError(
                f"{saved.path}: a finished image, and {self.first.path} is a part: merge all parts "
                "of a render first, then the images"
            )
        changes = differences(saved.facts, self.facts, but=("part",))
        if changes:
            text = "; ".join(changes)
            raise UsageError(f"{saved.path}: not of the render of {self.first.path}. It has {text}")
        self._count_steps(saved)
        state, other = self.state, saved.state
        if state.channels != other.channels or len(other.sums) != 1:
            raise UsageError(f"{saved.path}: has other channels than {self.first.path}")
        if state.sums[0].parts.shape != other.sums[0].parts.shape:
            raise UsageError(f"{saved.path}: has another size than {self.first.path}")
        state.sums[0].merge(other.sums[0])
        history = state.history
        history.samples[0] += other.history.samples[0]
        history.steps += other.history.steps
        history.seconds += other.history.seconds
        new = [name for name in other.processors if name not in state.processors]
        state.processors += new
        state.learnt = state.learnt if state.learnt.size else other.learnt
        saved.state = None
        self.files.append(saved)

    def _count_steps(self, saved: Saved) -> None:
        """Add the steps of a file to those that are there, once each."""
        mine = steps_of(saved.runs, self.steps)
        if (mine > 1).any():
            raise UsageError(f"{saved.path}: not a whole {WHAT} (it has a step twice)")
        self.times += mine
        if not (self.times > 1).any():
            return
        known = [(other.path, run) for other in self.files for run in other.runs]
        for path, run in known:
            if (steps_of([run], self.steps) * mine).any():
                words = run.words(self.steps)
                raise UsageError(f"{words} comes twice: in {path} and in {saved.path}")

    def finish(self, target: Path | None, partial: bool, denoise: bool, stops: float) -> Merged:
        """Make the image, and write it or, if parts are missing, the sums."""
        runs = [run for saved in self.files for run in saved.runs]
        missing = gaps(runs, self.steps)
        words = missing.words(self.steps)
        if missing and not partial:
            option = typed("partial=True", "--partial")
            raise UsageError(f"missing: {words}{self._remedy(missing)} ({option} does without)")
        state, samples = self.state, self.state.history.spp
        if not samples:
            raise UsageError(f"{self.first.path}: no samples yet, missing: {words}")
        bitmap = _developed(self.first, state)
        merged = Merged(bitmap, samples, words, _notes(state))
        if target is None:
            return merged
        if missing:
            facts = {**self.facts, "part": MERGED}
            first, standard = self.first, self._standard()
            saved = Saved(target, facts, runs, state, first.shown, first.command, standard)
            previews, notes = images.write_preview(bitmap, target, stops=stops)
            merged.files = [state_file.write(saved), *previews]
        else:
            told = self._standard() | _own(merged, self.facts, state.history.seconds)
            facts = {**self.facts, "seeds": [self.facts["seed"]]}
            notes = _write(merged, target, {}, facts, told, denoise, stops)
        merged.notes += notes
        return merged

    def _standard(self) -> dict[str, Any]:
        return metadata.shared(saved.standard for saved in self.files)

    def _remedy(self, missing) -> str:
        """Return how to render what is missing."""
        command = next((saved.command for saved in self.files if saved.command), None)
        if missing.parts:
            part = missing.parts[0]
            text = f"render(..., part=({part.number}, {part.count}))"
            if command:
                text = shlex.join(["manylights", *command, "--part", str(part)])
            return f"; this renders part {part.number}: {text}"
        part = missing.unfinished[0].part
        if not command:
            return ""
        if not any(word.startswith("--checkpoint") for word in command):
            command = [*command, "--checkpoint", "60"]
        text = shlex.join(["manylights", *command, "--part", str(part)])
        return f"; this goes on with part {part.number}: {text}"


def _notes(state: State) -> list[str]:
    if len(state.processors) < 2:
        return []
    count, names = len(state.processors), ", ".join(state.processors)
    return [f"processors: rendered on {count} types, which may round differently: {names}"]


def _developed(saved: Saved, state: State):
    """Return the image of a state as the film of its render would."""
    facts, names = saved.facts, state.channels
    added = names[names.index(WEIGHT) + 1 :] if WEIGHT in names else []
    shown = tuple(saved.shown[: len(saved.shown) - len(added)])
    if facts["film"] not in FILMS or shown not in FORMATS:
        raise UsageError(f"{saved.path}: parts of a {facts['film']} cannot be merged")
    height, width = state.sums[0].rounded.shape[:2]
    size = {"width": width, "height": height}
    film = mi.load_dict({"type": "hdrfilm", "pixel_format": FORMATS[shown], **size})
    film.prepare(added)
    return develop(film, state.total(facts["adjoint"]), facts["exposure"])[1]


def _signature(facts: dict, samples: int) -> dict[str, str]:
    """Return what a finished render says of itself."""
    own = {name: facts[name] for name in facts if name not in STATE}
    return state_file.signature({**own, "part": "1/1", "seeds": facts["seeds"]}, samples)


def _own(merged: Merged, facts: dict, seconds: float) -> dict[str, Any]:
    """Return what it says beside facts; files of before may lack the integrator's parameters."""
    told = metadata.own(merged.samples, seconds, facts.get("parameters", ""))
    return {name: value for name, value in told.items() if value != ""}


def _write(
    merged: Merged,
    target: Path,
    layers: dict,
    facts: dict,
    told: dict[str, Any],
    denoise: bool,
    stops: float,
) -> list[str]:
    """Write the image of finished parts or images; return notes about that.

    Args:
        merged: the image.
        target: of the file.
        layers: further channels.
        facts: of the job, with the ``seeds``.
        told: other attributes of the file.
        denoise, stops: arguments of :func:`merge`.
    """
    names, shown = channels.names(merged.bitmap), None
    if denoise:
        pixels = np.array(merged.bitmap, copy=False).reshape(*merged.bitmap.size()[::-1], -1)
        kinds = (*denoising.GUIDES, denoising.EMISSION)
        guides = [name for name in layers if name.startswith(kinds)]
        planes = [pixels, *(layers[name][..., np.newaxis] for name in guides)]
        pixels = np.concatenate(planes, axis=2)
        shown = denoising.denoised(pixels, [*names, *guides], float(facts["exposure"]))
        layers = layers | channels.color_layers(channels.DENOISED, shown)
    own = _signature(facts, merged.samples) | told
    number = np.float16 if facts["number"] == "float16" else np.float32
    merged.files, notes = images.write_images(
        merged.bitmap, target, layers, own, number, merged.samples, shown, stops
    )
    return notes


def _merge_images(
    first: Saved,
    planes: dict,
    paths: list[Path],
    target: Path | None,
    denoise: bool,
    stops: float,
) -> Merged:
    """Return the mean of finished images."""
    facts, owners = first.facts, dict.fromkeys(first.facts["seeds"], first.path)
    standards, seconds = [first.standard], facts.get("seconds_taken", 0.0)
    names = [name for name in planes if channels.is_averaged(name)]
    # The variance of a mean: weights are squared
    powers = {name: 2 if name.startswith(channels.VARIANCE) else 1 for name in names}
    total = {name: np.zeros(planes[name].shape) for name in names}
    samples, saved = 0, first
    for path in [None, *paths]:
        if path is not None:
            saved, planes = state_file.read(path, WHAT, "")
            found = [name for name in planes if channels.is_averaged(name)]
            _check_image(saved, found, first, names, owners)
            standards.append(saved.standard)
            seconds += saved.facts.get("seconds_taken", 0.0)
        weight = saved.facts["samples_done"]
        for name in names:
            total[name] += planes[name].astype(np.float64) * float(weight) ** powers[name]
        samples += weight
    means = {name: total[name] / float(samples) ** powers[name] for name in names}
    shown = channels.shown(names)
    layers = {name: means[name].astype(np.float32) for name in names if name not in shown}
    pixels = np.stack([means[name] for name in shown], axis=-1).astype(np.float32)
    for color, plane in light_groups.sums(layers).items():
        pixels[..., shown.index(color)] = plane
    bitmap = channels.join(shown, pixels)
    count = 1 + len(paths)
    text = f"images: the mean of {count}, weighted by samples; their sums are not in the files"
    merged = Merged(bitmap, samples, "", [text])
    if target is not None:
        told = metadata.shared(standards) | _own(merged, facts, seconds)
        facts = {**facts, "seeds": sorted(owners)}
        merged.notes += _write(merged, target, layers, facts, told, denoise, stops)
    return merged


def _check_image(saved: Saved, names, first: Saved, expected, owners: dict[int, Path]) -> None:
    """Check that an image may be averaged with others, and add its seeds to ``owners``."""
    if saved.state is not None:
        raise UsageError(
            f"{saved.path}: a part, and {first.path} is a finished image: merge all parts of a "
            "render first, then the images"
        )
    changes = differences(
        saved.facts, first.facts, but=("part", "seed", "spp", "step_count", "steps")
    )
    if changes:
        text = "; ".join(changes)
        raise UsageError(
            f"{saved.path}: differs from {first.path} not in the seed alone. It has {text}"
        )
    if names != expected:
        raise UsageError(f"{saved.path}: has other channels than {first.path}")
    for seed in saved.facts["seeds"]:
        if seed in owners:
            raise UsageError(f"seed {seed} comes twice: in {owners[seed]} and in {saved.path}")
        owners[seed] = saved.path

"""Makes other images of one render with layers of light groups: lamps brighter, darker, or off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Union

import numpy as np

from manylights import files
from manylights.errors import UsageError, argument, check
from manylights.output import channels, denoise, exr, images, light_groups
from manylights.threads import require_variant

#: What is true of the image as it was rendered alone. Which group a lamp in sight is of, whose
#: emission a layer has, is not in the file.
OF_THE_RENDER = (channels.VARIANCE, channels.DENOISED, f"{denoise.EMISSION}.")

#: Facts about it that are not those of a mix.
OWN_FACTS = ("noise",)

Weight = Union[float, Sequence[float]]


@dataclass
class Mixed:
    """A mix.

    Attributes:
        image: red, green and blue, shape (height, width, 3), single precision.
        notes: lines for people.
        files: that were written.
    """

    image: np.ndarray
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


def mix(
    path: str | Path,
    weights: Mapping[str, Weight],
    output: str | Path | None = None,
    exposure: float = 0.0,
) -> Mixed:
    """Multiply the layers of light groups of a render, and make the image their sum.

    All in single precision: each layer is a product, the image the sum of the layers in the order
    of their channels' names. Groups without a weight stay as they are; of a mix another mix can be
    made. Layers of surfaces and attributes of the file are kept; what is that of the render alone
    (``variance``, ``emission``, ``denoised``) is left out.

    Args:
        path: an image that ``render(..., light_groups=...)`` or ``manylights render`` wrote.
        weights: by group: a number, or three for red, green and blue; finite, 0 or more.
        output: file (.exr) to write to, with a PNG beside it. Default: none.
        exposure: stops by which the PNG is brighter, from -64 to 64.

    Raises:
        UsageError: (a ``ValueError``) no render of ours, no such group, a wrong weight, or
            the output is the same file.
        RuntimeError: there is an output, and no variant of Mitsuba is set.
    """
    target = None if output is None else images.check_output(str(output))
    if target is not None:
        require_variant()
    images.check_stops(exposure)
    path = files.path_of("path", path)
    if target is not None:
        files.check_apart(target, [path])
    check("weights", weights, isinstance(weights, Mapping), "a dictionary of factors by group")
    planes, attributes = exr.read(path)
    groups = light_groups.groups(planes)
    _check_file(path, groups, attributes)
    factors = {name: _factors(name, weight) for name, weight in weights.items()}
    for name in factors:
        if name not in groups:
            raise UsageError(f"{path}: no light group {name}, it has {', '.join(groups)}")
    kept = {name: plane for name, plane in planes.items() if not name.startswith(OF_THE_RENDER)}
    _multiply(kept, factors)
    kept |= light_groups.sums(kept)
    mixed = Mixed(np.stack([kept[color] for color in channels.RGB], axis=-1))
    dropped = sorted({name.partition(".")[0] for name in planes.keys() - kept.keys()})
    if dropped:
        mixed.notes.append(f"left out, since it is that of the render: {', '.join(dropped)}")
    if target is not None:
        mixed.files = [exr.write(target, kept, _signed(attributes, factors))]
        names = [name for name in (*channels.RGB, "A") if name in kept]
        picture = channels.join(names, np.stack([kept[name] for name in names], axis=-1))
        previews, notes = images.write_preview(picture, target, stops=exposure)
        mixed.files += previews
        mixed.notes += notes
    return mixed


def _check_file(path: Path, groups: list[str], attributes: dict) -> None:
    if not any(name.startswith(exr.OURS) for name in attributes):
        raise UsageError(f"{path}: no render of manylights, it has no {exr.OURS}* in it")
    if f"{exr.OURS}channels" in attributes:
        raise UsageError(f"{path}: a part or checkpoint, merge all parts of the render first")
    if not groups:
        raise UsageError(f"{path}: no light groups, render it with {argument('light_groups')}")


def _factors(name: str, weight: Weight) -> list[np.float32]:
    """Return a weight as three numbers in single precision."""
    weight = weight.tolist() if isinstance(weight, np.ndarray) else weight
    numbers = list(weight) if isinstance(weight, Sequence) else [weight] * 3
    largest = float(np.finfo(np.float32).max)
    real = len(numbers) == 3 and all(isinstance(number, Real) for number in numbers)
    if not real or not all(0.0 <= number <= largest for number in numbers):
        raise UsageError(f"{name}={weight}: must be one or three finite numbers of at least 0")
    return [np.float32(number) for number in numbers]


def _multiply(planes: dict[str, np.ndarray], factors: dict[str, list[np.float32]]) -> None:
    """Multiply the layers among the channels of an image, in place."""
    for name, weights in factors.items():
        for color, weight in zip(channels.RGB, weights):
            layer = f"{light_groups.PREFIX}{name}.{color}"
            # What is infinite is off, too, where its lamp is.
            product = planes[layer].astype(np.float32) * (weight or np.float32(1.0))
            planes[layer] = product if weight else np.zeros_like(product)


def _signed(attributes: dict, factors: dict[str, list[np.float32]]) -> dict:
    """Return what a mix says of itself: what the render does, and the weights of all mixes."""
    kept = {
        name: value
        for name, value in attributes.items()
        if name.removeprefix(exr.OURS) not in OWN_FACTS
    }
    before = exr.fact(kept.get(f"{exr.OURS}mix", "{}"))
    now = {name: [float(weight) for weight in weights] for name, weights in factors.items()}
    total = {
        name: [a * b for a, b in zip(before.get(name, [1.0] * 3), now.get(name, [1.0] * 3))]
        for name in {**before, **now}
    }
    return {**kept, f"{exr.OURS}mix": total}

"""Layers with the light of groups of lights: ``RGBA_key.R``, ``RGBA_key.G`` and so on.

The image is their sum: in single precision, one layer after the other in the order of the names of
their channels, which is that of OpenEXR files. A file has them with 32 bits, and the image, too.
Alpha, which is not light, is that of the image in each layer.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from manylights.output.channels import RGB

#: Before the name of a group.
PREFIX = "RGBA_"

#: The group of all lights that are in no other.
REST = "rest"


def groups(names) -> list[str]:
    """Return the groups that have layers among channels, in the order of the layers."""
    return [name[len(PREFIX) : -2] for name in of_color(names, "R")]


def of_color(names, color: str) -> list[str]:
    """Return the channels of all layers with a colour ("R"), in the order of the layers."""
    return sorted(name for name in names if name.startswith(PREFIX) and name.endswith(f".{color}"))


def all_channels(names) -> list[str]:
    """Return the channels with colours of all layers."""
    return [name for color in RGB for name in of_color(names, color)]


def add_up(pixels: np.ndarray, names: list[str]) -> None:
    """Make the image the sum of its layers, in place; of an image without layers nothing changes.

    Args:
        pixels: shape (height, width, channels), single precision.
        names: of the channels.
    """
    planes = {name: pixels[..., index] for index, name in enumerate(names)}
    for color, plane in sums(planes).items():
        if color in planes:
            planes[color][...] = plane


def sums(planes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the sums of the layers among some channels, by colour; none if there are no layers."""
    layers = {color: [planes[name] for name in of_color(planes, color)] for color in RGB}
    return {color: total(found) for color, found in layers.items() if found}


def total(layers: list[np.ndarray]) -> np.ndarray:
    """Return the sum of layers in single precision, one after the other."""
    result = layers[0].astype(np.float32)
    for layer in layers[1:]:
        result += layer.astype(np.float32)
    return result


def alphas(planes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the alpha channels of the layers of a file, if its image has alpha."""
    if "A" not in planes:
        return {}
    return {f"{PREFIX}{group}.A": planes["A"] for group in groups(planes)}

"""Products of vectors; numpy's own are slow for the few rows of small meshes."""

from __future__ import annotations

import numpy as np


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors in the last axis; both have the same shape."""
    result = np.empty_like(a)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        result[..., k] = a[..., i] * b[..., j] - a[..., j] * b[..., i]
    return result


def unit(rows: np.ndarray) -> np.ndarray:
    """Return vectors of length 1, those that are zero unchanged."""
    length = np.sqrt((rows * rows).sum(axis=-1, keepdims=True))
    return rows / np.where(length > 1e-30, length, 1)


def area_vectors(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normal of each triangle, as long as its area."""
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    return cross(b - a, c - a) / 2

"""Primvars as arrays: any value type, indexed or not, and spread over corners, points or faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import UsdGeom

#: Interpolations whose values belong to points
PER_POINT = ("vertex", "varying")


@dataclass
class Sizes:
    """How many values an interpolation has on one prim.

    Attributes:
        faces: authored faces.
        points: points.
        corners: corners of all faces.
    """

    faces: int
    points: int
    corners: int

    def of(self, interpolation: str) -> int:
        """Return the number of values of an interpolation."""
        if interpolation in PER_POINT:
            return self.points
        return {"constant": 1, "uniform": self.faces, "faceVarying": self.corners}[interpolation]


@dataclass
class Values:
    """The values of a primvar.

    Attributes:
        array: ``(n, k)`` float32, not indexed any more.
        interpolation: one of ``UsdGeom.Tokens``, for example ``"faceVarying"``.
    """

    array: np.ndarray
    interpolation: str

    def on_corners(self, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """Return one row for each corner of a mesh with these faces."""
        if self.interpolation == "constant":
            return np.broadcast_to(self.array[0], (len(indices), self.array.shape[1]))
        if self.interpolation == "uniform":
            return np.repeat(self.array, counts, axis=0)
        return self.array if self.interpolation == "faceVarying" else self.array[indices]


def as_rows(value, width: int) -> np.ndarray | None:
    """Return an array of vectors or numbers as ``(n, width)`` float32, ``None`` if it is none."""
    try:
        array = np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError):
        return None
    if array.ndim == 1 and width > 1 and array.size == width:
        array = array[None]  # a single vector, not an array of them
    if width == 1 and array.ndim < 2:
        array = array.reshape(-1, 1)
    return array if array.ndim == 2 and array.shape[1] == width else None


def integers(value) -> np.ndarray:
    """Return an array of whole numbers as ``(n,)`` int64, an empty one for ``None``.

    Raises:
        ValueError: they are of another type.
    """
    array = np.asarray(value if value is not None else [])
    if array.size and array.dtype.kind not in "iu":
        shown = " ".join(str(value).split())[:60]
        raise ValueError(f"{shown} is no array of whole numbers")
    return array.astype(np.int64).ravel()


def read_primvar(primvar, width: int, sizes: Sizes, context) -> Values | None:
    """Read a ``UsdGeom.Primvar``, ``None`` and a note if it does not fit its prim."""
    if not primvar:
        return None
    value = context.value(primvar.GetAttr())
    rows = None if value is None else as_rows(value, width)
    if rows is None and width == 3 and (four := as_rows(value, 4)) is not None:
        rows = four[:, :3]  # colors with alpha
    if rows is None and value is not None and np.size(value):
        text = f"values that are not {width} numbers each are not used"
        context.notes.add("primvar type", text, primvar.GetAttr().GetPath())
    if rows is None or not len(rows):
        return None
    indices = context.value(primvar.GetIndicesAttr()) if primvar.IsIndexed() else None
    where = f"{primvar.GetAttr().GetPath()}"
    if indices is not None and len(indices):
        rows = _indexed(rows, integers(indices), where, context.notes)
    return fitting(rows, primvar.GetInterpolation(), sizes, where, context.notes)


def _indexed(rows: np.ndarray, indices: np.ndarray, where: str, notes) -> np.ndarray:
    outside = (indices < 0) | (indices >= len(rows))
    if outside.any():
        notes.add(
            "primvar indices", f"indices out of 0..{len(rows) - 1} are taken as the first", where
        )
        indices = np.where(outside, 0, indices)
    return rows[indices]


def fitting(rows, interpolation: str, sizes: Sizes, where: str, notes) -> Values | None:
    """Return rows with their interpolation, ``None`` and a note if their number does not fit."""
    if interpolation == "constant" or (len(rows) == 1 and sizes.of(interpolation) != 1):
        return Values(rows[:1], "constant")
    if len(rows) != sizes.of(interpolation):
        text = f"{len(rows)} values do not fit the interpolation {interpolation}, which has "
        notes.add("primvar size", f"{text}{sizes.of(interpolation)}: not used", where)
        return None
    return Values(rows, interpolation)


def find(prim, name: str):
    """Return a primvar that a prim has or inherits."""
    return UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)


def texture_coordinates(prim, sizes: Sizes, context) -> dict[str, Values]:
    """Return all texture coordinates of a prim by name, ``st`` first if there is one."""
    found = {}
    for primvar in UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance():
        kind = primvar.GetTypeName()
        in_plane = kind.scalarType.cppTypeName in ("GfVec2f", "GfVec2d", "GfVec2h")
        if in_plane or kind.role == "TextureCoordinate":
            values = read_primvar(primvar, 2 if in_plane else 3, sizes, context)
            if values is not None:
                values.array = values.array[:, :2]
                found[primvar.GetPrimvarName()] = finite(values, primvar, context.notes)
    return dict(sorted(found.items(), key=lambda item: (item[0] != "st", item[0])))


def finite(values: Values, primvar, notes) -> Values:
    """Return values with zeros in place of what is not finite, and a note."""
    bad = ~np.isfinite(values.array)
    if bad.any():
        notes.add(
            "primvar not finite", "NaN or infinite values become 0", primvar.GetAttr().GetPath()
        )
        values.array = np.where(bad, np.float32(0), values.array)
    return values


def display_color(prim, sizes: Sizes, context) -> tuple[Values | None, Values | None]:
    """Return displayColor, or what the context has in its place, and displayOpacity, in 0..1."""
    result = []
    for name, width in ((context.color_primvar, 3), ("displayOpacity", 1)):
        primvar = find(prim, name)
        values = read_primvar(primvar, width, sizes, context)
        if values is not None:
            values = finite(values, primvar, context.notes)
            values.array = np.clip(values.array, 0, 1)
        result.append(values)
    return result[0], result[1]

"""Grey materials that may emit a constant radiance."""

from __future__ import annotations

from dataclasses import dataclass, field

from pxr import UsdShade


@dataclass
class Material:
    """A material, see :class:`Materials`."""

    bsdf: dict
    emission: dict | None = None
    uv_primvar: str | None = None
    notes: list = field(default_factory=list)


class Materials:
    """The materials of a stage."""

    def __init__(self, context) -> None:
        self.context = context
        self._known = {}

    def bsdf(self, prim) -> Material:
        """Return the material that a prim is bound to."""
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        key = material.GetPath() if material else None
        if key not in self._known:
            self._known[key] = self._read(material)
        return self._known[key]

    def _read(self, material) -> Material:
        color, emission = (0.18,) * 3, None
        if material:
            shader = material.ComputeSurfaceSource()[0]
            value = shader.GetInput("diffuseColor").Get() if shader else None
            color = color if value is None else tuple(value)
            value = shader.GetInput("emissiveColor").Get() if shader else None
            emission = None if value is None else {"type": "rgb", "value": [*map(float, value)]}
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [*map(float, color)]}}
        return Material({"type": "twosided", "bsdf": diffuse}, emission)

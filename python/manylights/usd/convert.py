"""Writes a stage as XML, with its meshes and pictures in files beside it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import mitsuba as mi
import numpy as np

from manylights.usd.description import MeshShape
from manylights.usd.reader import SceneDict

#: Parameters of plugins that take a picture in memory, which is read from ``filename`` in XML.
PICTURE = "bitmap"


class Writer:
    """Turns a description into one that refers to files only.

    Attributes:
        folder: where the files go, beside the XML file.
        files: those that were written.
    """

    def __init__(self, description: dict, xml: Path) -> None:
        self.folder = xml.with_suffix("")
        self.files: list[Path] = []
        self._uses = Counter()
        self._pictures: dict[int, str] = {}
        self._count_uses(description)
        self._shared: dict[int, tuple[str, dict]] = {}

    def scene(self, description: dict) -> dict:
        """Return the scene, with materials that several shapes have in front of them."""
        entries = {key: self._value(key, value) for key, value in description.items()}
        materials = dict(self._shared.values())
        return {"type": "scene", **materials, **entries}

    def _count_uses(self, part) -> None:
        if isinstance(part, MeshShape):
            self._uses[id(part.bsdf)] += 1
        elif isinstance(part, dict):
            for key, value in part.items():
                if key == "bsdf":
                    self._uses[id(value)] += 1
                else:
                    self._count_uses(value)

    def _value(self, name: str, value):
        if isinstance(value, MeshShape):
            return self._mesh(name, value)
        if isinstance(value, dict):
            return self._dictionary(name, value)
        return value

    def _dictionary(self, name: str, part: dict) -> dict:
        result = {}
        for key, value in part.items():
            if key == "bsdf" and isinstance(value, dict):
                result[key] = self._bsdf(value)
            elif key == PICTURE and isinstance(value, mi.Bitmap):
                result["filename"] = self._picture(name, value, part.get("raw", False))
            else:
                result[key] = self._value(f"{name}_{key}", value)
        return result

    def _bsdf(self, bsdf: dict) -> dict:
        if self._uses[id(bsdf)] < 2 or bsdf.get("type") == "ref":
            return self._dictionary("bsdf", bsdf)
        if id(bsdf) not in self._shared:
            name = f"material_{len(self._shared)}"
            self._shared[id(bsdf)] = name, self._dictionary(name, bsdf)
        return {"type": "ref", "id": self._shared[id(bsdf)][0]}

    def _mesh(self, name: str, mesh: MeshShape) -> dict:
        bare = MeshShape(mesh.positions, mesh.faces, mesh.normals, mesh.uv, mesh.attributes)
        file = self._file(name, ".ply")
        bare.instantiate(name, {}).write_ply(str(file))
        shape = {"type": "ply", "filename": self._relative(file)}
        if mesh.normals is None:
            shape["face_normals"] = True
        if mesh.bsdf is not None:
            shape["bsdf"] = self._bsdf(mesh.bsdf)
        if mesh.radiance is not None:
            radiance = self._dictionary(f"{name}_radiance", mesh.radiance)
            shape["emitter"] = {"type": "area", "radiance": radiance}
        return shape

    def _picture(self, name: str, bitmap: mi.Bitmap, raw: bool) -> str:
        """Return the file of a picture: PNG if that keeps what it means, else OpenEXR."""
        if id(bitmap) not in self._pictures:
            bytes_ = bitmap.component_format() == mi.Struct.Type.UInt8
            keeps = bytes_ and (raw or bitmap.srgb_gamma())
            file = self._file(name, ".png" if keeps else ".exr")
            if not keeps:
                bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
            bitmap.write(str(file))
            self._pictures[id(bitmap)] = self._relative(file)
        return self._pictures[id(bitmap)]

    def _file(self, name: str, ending: str) -> Path:
        self.folder.mkdir(exist_ok=True)
        plain = "".join(c if c.isalnum() or c in "_-" else "_" for c in name)
        file = self.folder / f"{len(self.files):04d}_{plain[-80:]}{ending}"
        self.files.append(file)
        return file

    def _relative(self, file: Path) -> str:
        return f"{self.folder.name}/{file.name}"


def write_xml(description: SceneDict, xml: Path) -> list[Path]:
    """Write what ``describe`` returned as XML, and return all files that were written.

    Args:
        description: of a stage; instances of meshes stay instances.
        xml: the file to write; its pictures and meshes go into the folder of its name.
    """
    writer = Writer(description, xml)
    scene = writer.scene(_plain(description))
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_dict(config, scene)
    mi.parser.write_file(state, str(xml))
    return [xml, *writer.files]


def _plain(part):
    """Return a description with numbers of numpy as those of Python, which the parser knows."""
    if isinstance(part, dict):
        return {key: _plain(value) for key, value in part.items()}
    return part.item() if isinstance(part, np.generic) else part

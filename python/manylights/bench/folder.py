"""The folder of a measurement: ``results.json`` and images, written whole after each step."""

from __future__ import annotations

import json
import os
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.bench import machine, metrics, records
from manylights.bench.methods import Method
from manylights.bench.scene_source import Source
from manylights.errors import UsageError
from manylights.output import channels, images

#: What must be the same for results to be continued: times of two machines do not compare, and
#: other versions may compute something else.
SAME_VERSIONS = ("manylights", "mitsuba", "drjit")
SAME_MACHINE = ("processor", "threads")


class Folder:
    """The results in a folder.

    Attributes:
        folder: where they are.
        data: the content of ``results.json``.
    """

    def __init__(self, folder: Path, data: dict[str, Any]) -> None:
        self.folder, self.data = folder, data

    def save(self) -> None:
        """Write ``results.json``, whole or not at all."""
        scenes = [_without_empty_points(entry) for entry in self.data["scenes"]]
        text = json.dumps({**self.data, "scenes": scenes}, indent=1, allow_nan=False)
        with files.written_whole(self.folder / records.FILE) as partial:
            partial.write_text(text)

    def write_image(self, scene: str, name: str, pixels: np.ndarray, names) -> None:
        """Write ``SCENE/NAME.exr``, whole or not at all, in single precision."""
        target = self.folder / scene / f"{name}.exr"
        bitmap = channels.join(names, pixels)
        images.write_whole(bitmap, target, mi.Bitmap.FileFormat.OpenEXR)

    def read_reference(self, scene: str) -> np.ndarray:
        """Return the reference of a scene, shape (height, width, 3)."""
        return channels.read_colors(self.folder / scene / "reference.exr")

    def has_image(self, scene: str, name: str) -> bool:
        """Is there ``SCENE/NAME.exr``?"""
        return (self.folder / scene / f"{name}.exr").is_file()

    def find(self, source: Source) -> dict[str, Any] | None:
        """Return the entry of a scene, None if there is none or the scene has changed."""
        wanted = (source.text, source.fingerprint)
        scenes = self.data["scenes"]
        return next((e for e in scenes if (e["source"], e["hash"]) == wanted), None)

    def scene(self, source: Source, **facts: Any) -> dict[str, Any]:
        """Return the entry of a scene: that of an earlier run if the scene is the same.

        A scene whose content has changed starts anew. Another one of the same name gets a number.

        Args:
            source: the scene.
            facts: values for keys of the entry, of which ``name`` is what to call it.
        """
        scenes = self.data["scenes"]
        for index, entry in enumerate(scenes):
            if entry["source"] != source.text:
                continue
            if entry["hash"] != source.fingerprint:
                scenes[index] = self._entry(source, {**facts, "name": entry["name"]})
            return scenes[index]
        taken = {entry["name"] for entry in scenes}
        name, number = facts["name"], 2
        while name in taken:
            name, number = f"{facts['name']}_{number}", number + 1
        scenes.append(self._entry(source, {**facts, "name": name}))
        return scenes[-1]

    def _entry(self, source: Source, facts: dict[str, Any]) -> dict[str, Any]:
        folder = self.folder / facts["name"]
        folder.mkdir(exist_ok=True)
        # Of a scene that was of this name and has changed.
        for path in (*folder.glob("*.exr"), *folder.glob("*.npz")):
            path.unlink()
        origin = {"source": source.text, "hash": source.fingerprint}
        return records.new_scene({**facts, **origin})


def open_folder(folder: str, variant: str) -> Folder:
    """Return the results in a folder, or empty ones in a new folder.

    Args:
        folder: made if there is none.
        variant: of Mitsuba.

    Raises:
        UsageError: the folder cannot be written, or its results are of another variant, machine or
            version, or no results of ours.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"--out {folder}: not a folder that can be made ({error.strerror})"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise UsageError(f"--out {folder}: not writable")
    fresh = _fresh(variant)
    if not (path / records.FILE).exists():
        return Folder(path, fresh)
    data = records.read(path / records.FILE)
    for what, old, new in _differences(data, fresh):
        raise UsageError(
            f"--out {folder}: has results with {what} {old}, this is {new}; choose another folder"
        )
    return Folder(path, data)


def series_of(entry: dict[str, Any], method: Method) -> dict[str, Any] | None:
    """Return the measurements of a method in a scene's entry, None if there are none."""
    return next((series for series in entry["series"] if series["spec"] == method.spec), None)


def skip(entry: dict[str, Any], method: Method, why: str) -> None:
    """Note in a scene's entry why a method is not measured."""
    unskip(entry, method)
    entry["skipped"].append({"spec": method.spec, "why": why})


def unskip(entry: dict[str, Any], method: Method) -> None:
    """Forget in a scene's entry that a method is not measured."""
    entry["skipped"] = [item for item in entry["skipped"] if item["spec"] != method.spec]


def is_skipped(entry: dict[str, Any], method: Method) -> bool:
    """Is it noted why this method is not measured?"""
    return any(item["spec"] == method.spec for item in entry["skipped"])


def _without_empty_points(entry: dict[str, Any]) -> dict[str, Any]:
    """Return a scene's entry without numbers of samples that are planned and not yet rendered."""
    series = [
        item
        | {
            kind: [point for point in item[kind] if point["seed"]]
            for kind in ("points", "denoised")
            if item.get(kind)
        }
        for item in entry["series"]
    ]
    return {**entry, "series": series}


def _fresh(variant: str) -> dict[str, Any]:
    return {
        "format": records.FORMAT,
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "versions": machine.versions(),
        "machine": machine.describe(),
        "variant": variant,
        "metric": {"epsilon": metrics.EPSILON, "trim": metrics.TRIM},
        "scenes": [],
    }


def _differences(data: dict[str, Any], fresh: dict[str, Any]):
    """Yield (what, old, new) for all that forbids to go on with old results."""
    pairs = [("variant", data.get("variant"), fresh["variant"])]
    for group, names in (("versions", SAME_VERSIONS), ("machine", SAME_MACHINE)):
        for name in names:
            pairs.append((name, data.get(group, {}).get(name), fresh[group][name]))
    return [pair for pair in pairs if pair[1] != pair[2]]

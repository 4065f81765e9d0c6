"""The scene's files on their way to workers that have no folder in common with the client."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from manylights.errors import UsageError, argument
from manylights.loading import LoadedScene

#: Endings of texts that name other files.
TEXTS = (".xml", ".usda")


class Cargo:
    """The files of a scene, held by workers for those that come later.

    Args:
        client: ``distributed.Client``.
        loaded: the scene.
        ship: are they sent at all?

    Raises:
        UsageError: a file names another one by its absolute path.
    """

    def __init__(self, client, loaded: LoadedScene, ship: bool) -> None:
        self.client, self.futures = client, []
        self.path = os.path.abspath(loaded.arguments.get("path", "."))
        paths = [os.path.abspath(path) for path in (self.path, *loaded.files)] if ship else []
        self.paths = list(dict.fromkeys(paths))
        self.root = os.path.commonpath([os.path.dirname(path) for path in paths]) if paths else ""
        for path in self.paths:
            check_names(Path(path), self.paths)

    def order(self) -> dict[str, Any]:
        """Return what workers have to know: where the scene is, and names of files to unpack."""
        names = [Path(path).relative_to(self.root).as_posix() for path in self.paths]
        return {"path": self.path, "scene": names[0] if names else "", "names": names}

    def files(self) -> list:
        """Return Dask's futures of the contents, which are sent once, or again if they are lost."""
        if self.paths and not self._are_there():
            contents = [np.fromfile(path, np.uint8) for path in self.paths]
            self.futures = self.client.scatter(contents, hash=False)
        return self.futures

    def _are_there(self) -> bool:
        return bool(self.futures) and all(one.status == "finished" for one in self.futures)

    def release(self) -> None:
        """Have the workers forget the contents."""
        with suppress(Exception):
            for future in self.futures:
                future.release()


def check_names(path: Path, files: list[str]) -> None:
    """Raise ``UsageError`` if a text names one of some files by its absolute path."""
    if path.suffix.lower() not in TEXTS:
        return
    text = path.read_text(errors="replace")
    named = next((file for file in files if file in text), None)
    if named is not None:
        raise UsageError(f"{argument('ship')}: {path} names {named}, which is elsewhere on workers")

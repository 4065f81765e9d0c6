"""Finds the compiled plugins and tells Mitsuba where they are."""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: The only Mitsuba release the compiled plugins fit: its C++ interface changes between releases.
REQUIRED_MITSUBA = "3.9.1"

#: Every installation has at least this plugin.
MAIN_PLUGIN = "manylights_direct"

#: Names a folder to search before the package: for developers, the build tree.
OVERRIDE = "MANYLIGHTS_PLUGIN_DIR"


def plugin_dir() -> str:
    """Return the folder to give to ``mitsuba -a``: the one that holds ``plugins/``.

    An editable installation spreads the package over two folders, the sources and the build, so
    each entry of the package's path is tried. The environment variable ``MANYLIGHTS_PLUGIN_DIR``
    comes first where it is set.

    Raises:
        ImportError: no folder holds the compiled plugin; the text says how to build it.
    """
    candidates = _candidates()
    for folder in candidates:
        if _holds_plugin(folder / "plugins"):
            return str(folder)
    searched = ", ".join(str(folder / "plugins") for folder in candidates)
    raise ImportError(
        f"manylights: the compiled plugin {MAIN_PLUGIN} is missing (searched {searched}). "
        "Build it with: pip install --force-reinstall --no-deps manylights, "
        "or in a checkout: pip install -e ."
    )


def register() -> None:
    """Add ``plugin_dir()`` to Mitsuba's search path, once.

    Raises:
        ImportError: Mitsuba is missing, has another version, or the plugins are not built.
    """
    mitsuba = _import_mitsuba()
    folder = plugin_dir()
    resolver = mitsuba.file_resolver()
    if folder not in [str(entry) for entry in resolver]:
        resolver.append(folder)


def _candidates() -> list[Path]:
    """Folders that may hold ``plugins/``, the preferred one first."""
    folders = [Path(entry) for entry in sys.modules["manylights"].__path__]
    override = os.environ.get(OVERRIDE)
    if override:
        folders.insert(0, Path(override))
    return [folder.resolve() for folder in folders]


def _holds_plugin(folder: Path) -> bool:
    names = (f"{MAIN_PLUGIN}{suffix}" for suffix in (".so", ".dylib", ".dll"))
    return any((folder / name).is_file() for name in names)


def _import_mitsuba():
    """Return the module ``mitsuba``, or raise ImportError with the command to type."""
    remedy = f"pip install mitsuba=={REQUIRED_MITSUBA}"
    try:
        import mitsuba
    except ModuleNotFoundError as error:
        if error.name != "mitsuba":
            raise
        raise ImportError(f"manylights needs Mitsuba. Install it with: {remedy}") from error
    if mitsuba.__version__ != REQUIRED_MITSUBA:
        raise ImportError(
            f"manylights is compiled for Mitsuba {REQUIRED_MITSUBA}, but Mitsuba "
            f"{mitsuba.__version__} is installed. Get the matching one with: {remedy}"
        )
    return mitsuba

"""Finds the compiled plugins and tells Mitsuba where they are."""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: The only Mitsuba release the compiled plugins fit: its C++ interface changes between releases.
REQUIRED_MITSUBA = "3.9.1"

#: What every installation has.
PLUGINS = ("manylights_direct", "manylights_volpath", "manylights_sobol")

#: Names the folder to use instead of the package's: for developers, the build tree.
OVERRIDE = "MANYLIGHTS_PLUGIN_DIR"


def plugin_dir() -> str:
    """Return the folder to give to ``mitsuba -a``: the one that holds ``plugins/``.

    An editable installation spreads the package over two folders, the sources and the build, so
    each entry of the package's path is tried. The environment variable ``MANYLIGHTS_PLUGIN_DIR``
    replaces them where it is set.

    Raises:
        ImportError: no folder holds the compiled plugins; the text says how to build them.
    """
    override = os.environ.get(OVERRIDE)
    package = sys.modules["manylights"].__path__
    folders = [Path(entry).resolve() for entry in ([override] if override else package)]
    for folder in folders:
        if not _missing(folder):
            return str(folder)
    named = f"{OVERRIDE}={override}: " if override else ""
    searched = "; ".join(f"no {', '.join(_missing(f))} in {f / 'plugins'}" for f in folders)
    raise ImportError(
        f"manylights: {named}compiled plugins are missing ({searched}). "
        "Build them with: pip install --force-reinstall --no-deps manylights, "
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


def _missing(folder: Path) -> list[str]:
    """Return the names of the plugins that are not in ``folder/plugins``."""
    suffixes = (".so", ".dylib", ".dll")
    return [
        name
        for name in PLUGINS
        if not any((folder / "plugins" / f"{name}{suffix}").is_file() for suffix in suffixes)
    ]


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

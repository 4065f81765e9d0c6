"""Finds the compiled plugins and tells Mitsuba where they are."""

from __future__ import annotations

import os
import re
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path

#: The Mitsuba release that this version is made for. Plugins fit one release, since its C++
#: interface changes between them; a package may have those of others, too.
REQUIRED_MITSUBA = "3.9.1"

#: What every installation has.
PLUGINS = ("manylights_direct", "manylights_volpath", "manylights_sobol")

#: Names the folder to use instead of the package's: for developers, the build tree.
OVERRIDE = "MANYLIGHTS_PLUGIN_DIR"


def plugin_dir() -> str:
    """Return the folder to give to ``mitsuba -a``: the one that holds ``plugins/``.

    It is ``mitsuba-3.9.1`` in the package, with the release of the Mitsuba that is installed. An
    editable installation leaves the package in the sources and puts the plugins where it would be
    otherwise, so both are tried. The environment variable ``MANYLIGHTS_PLUGIN_DIR`` replaces them
    where it is set.

    Raises:
        ImportError: Mitsuba is missing, no folder holds the compiled plugins, or only those of
            another release; the text says what to type.
    """
    release = _import_mitsuba().__version__
    override = os.environ.get(OVERRIDE)
    package = [*sys.modules["manylights"].__path__, f"{sysconfig.get_path('platlib')}/manylights"]
    # Each once, in their order
    entries = dict.fromkeys(Path(name).resolve() for name in ([override] if override else package))
    folders = [entry / f"mitsuba-{release}" for entry in entries]
    for folder in folders:
        if not _missing(folder):
            return str(folder)
    named = f"{OVERRIDE}={override}: " if override else ""
    releases = _releases(entries) or [REQUIRED_MITSUBA]
    if release not in releases:
        raise ImportError(
            f"manylights is compiled for Mitsuba {' and '.join(releases)}, but Mitsuba "
            f"{release} is installed. Get the matching one with: "
            f"pip install mitsuba=={releases[-1]}"
        )
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
    folder = plugin_dir()
    resolver = _import_mitsuba().file_resolver()  # pyright: ignore[reportCallIssue]
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


def _releases(folders: Iterable[Path]) -> list[str]:
    """Return the releases of Mitsuba that have a folder in one of these, oldest first."""
    names = {path.name for folder in folders for path in folder.glob("mitsuba-*")}
    return sorted(
        (name.removeprefix("mitsuba-") for name in names),
        key=lambda release: [int(number) for number in re.findall(r"\d+", release)],
    )


def _import_mitsuba():
    """Return the module ``mitsuba``, or raise ImportError with the command to type."""
    try:
        import mitsuba
    except ModuleNotFoundError as error:
        if error.name != "mitsuba":
            raise
        raise ImportError(
            f"manylights needs Mitsuba. Install it with: pip install mitsuba=={REQUIRED_MITSUBA}"
        ) from error
    return mitsuba

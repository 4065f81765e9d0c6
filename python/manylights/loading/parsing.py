"""Reads a scene file into Mitsuba's parsed form, and makes objects of it.

The ending of the file's name chooses the reader; after it XML and USD go the same way.
"""

from __future__ import annotations

import os
import re
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import mitsuba as mi

from manylights.errors import UsageError, argument, check, one_line, shown
from manylights.files import path_of

#: Endings of USD stages: whichever format, in text, binary, and packed.
USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")

#: Files that are taken for scenes by mistake.
IMAGE_ENDINGS = (".exr", ".hdr", ".png", ".jpg", ".jpeg")

#: Each level has four times as many faces: more fill the memory.
MOST_SUBDIVISION = 6


@dataclass(frozen=True)
class UsdOptions:
    """How a USD stage is read: the arguments of ``manylights.usd.load``, which says what each is.

    A new one is added there, here, and in ``cli/options.py`` (which has the groups of lights as an
    option of the integrator).
    """

    time: float | None = None
    camera: str | None = None
    purposes: tuple[str, ...] = ("default", "render")
    subdivision: int | None = None
    default_light: bool = False
    legacy_lights: bool = False
    blender_light_units: bool = False
    light_groups: str = ""

    def given(self) -> list[str]:
        """Return which arguments that stages alone have are not the default."""
        names = [known.name for known in fields(self) if known.name != "light_groups"]
        return [name for name in names if getattr(self, name) != getattr(UsdOptions, name)]


@dataclass
class ParsedScene:
    """A scene before any object exists.

    Attributes:
        config: ``mi.parser.ParserConfig`` to make the objects with.
        state: ``mi.parser.ParserState``: nodes with their properties.
        files: what it was read from, the scene file first, and the files that it refers to.
        notes: what the reader has to say, lines for the log.
        exposure: factor of the camera, which images are multiplied by.
    """

    config: Any
    state: Any
    files: list[Path]
    notes: list[str] = field(default_factory=list)
    exposure: float = 1.0


def parse(
    path: str,
    defines: dict[str, str] | None = None,
    usd_options: UsdOptions | None = None,
    light_groups: str = "",
) -> ParsedScene:
    """Parse a scene, upgraded to this Mitsuba, not transformed. Inside of ``search_beside``.

    Args:
        path: an XML file, or a USD stage if it ends in one of ``USD_ENDINGS``.
        defines: values for the ``<default>`` parameters of XML, by name. Default: none.
        usd_options: how a stage is read. Default: as ``UsdOptions()`` has it.
        light_groups: of the integrator, for stages, the reader of which merges lamps. Default:
            those of ``usd_options``.

    Raises:
        UsageError: there is no such file, it is an image, usd-core is missing, or there are
            ``defines`` for a stage or options of stages for XML.
        RuntimeError: Mitsuba cannot read it.
    """
    check_file(path, defines, usd_options)
    if _is_stage(path):
        options = usd_options or UsdOptions()
        groups = light_groups or options.light_groups
        return _parse_usd(path, replace(options, light_groups=groups))
    config = mi.parser.ParserConfig(mi.variant())
    try:
        state = mi.parser.parse_file(config, str(path), **(defines or {}))
    except RuntimeError as error:
        unused = re.findall(r"\$(\w+)=", str(error)) if "unused parameters" in str(error) else []
        if not unused:
            raise
        names, defined = ", ".join(unused), argument("defines")
        raise UsageError(f"{defined} {names}: {path} has no <default> of this name") from error
    mi.parser.transform_upgrade(config, state)
    return ParsedScene(config, state, files_of(state))


def check_file(path: str, defines: dict[str, str] | None, usd_options: UsdOptions | None) -> None:
    """Check what the name of a scene's file tells, without reading it: arguments of ``parse``.

    Raises:
        UsageError: as ``parse``.
    """
    path_of("path", path)
    check("defines", defines, defines is None or isinstance(defines, dict), "a dictionary")
    if not Path(path).is_file():
        folder = path and Path(path).is_dir()
        what = "is a folder, not a scene" if folder else "no such file"
        raise UsageError(f"{path or shown(path)}: {what}")
    if Path(path).suffix.lower() in IMAGE_ENDINGS:
        raise UsageError(f"{path}: is an image, not a scene (an XML file or a USD stage)")
    if _is_stage(path):
        if defines:
            name = f"{argument('defines')} {next(iter(defines))}"
            raise UsageError(f"{name}: {path} is USD, only XML has <default>")
        import_usd(path)
    elif usd_options and (given := usd_options.given()):
        raise UsageError(f"{argument(given[0])}: {path} is XML, that is for USD stages")


def _is_stage(path: str) -> bool:
    return Path(path).suffix.lower() in USD_ENDINGS


def _parse_usd(path: str, options: UsdOptions) -> ParsedScene:
    description = import_usd(path).load(path, **asdict(options))
    parsed = parse_description(description)
    # A stage composes layers that no node of the scene names.
    parsed.files = [*map(Path, description.files), *files_of(parsed.state)]
    return parsed


def parse_description(description: dict) -> ParsedScene:
    """Parse a dictionary as for ``mi.load_dict``, for example one of ``manylights.usd.load``."""
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_dict(config, description)
    notes = [note.text for note in getattr(description, "notes", ())]
    exposure = getattr(description, "exposure", 1.0)
    if exposure != 1.0:
        notes.append(f"camera: its exposure brightens the image {exposure:g} times")
    return ParsedScene(config, state, [], notes, exposure)


def import_usd(path: str):
    """Return the module ``manylights.usd``, to read ``path``.

    Raises:
        UsageError: usd-core is missing.
    """
    try:
        from manylights import usd
    except ImportError as error:
        if not isinstance(error.__cause__, ImportError):
            raise
        raise UsageError(f"{path}: {error}") from error
    return usd


def files_of(state) -> list[Path]:
    """Return the XML files of a parsed scene and the files that it refers to.

    Inside of ``search_beside``: Mitsuba looks for them as it will when it makes the scene.
    """
    files = [Path(str(file)) for file in state.files]
    for node in state.nodes:
        texts = [value for _, value in node.props.items() if isinstance(value, str)]
        found = [str(mi.file_resolver().resolve(text)) for text in texts]
        files += [Path(file) for file in found if os.path.isfile(file)]
    return files


def instantiate(parsed: ParsedScene):
    """Make Mitsuba's objects of a parsed scene, inside of ``search_beside``.

    Raises:
        UsageError: the file describes something that is not a scene, or an image is not whole.
        RuntimeError: Mitsuba cannot make something, or does not know one of its properties.
    """
    config, state = parsed.config, parsed.state
    _check_images(parsed.files)
    mi.parser.transform_resolve(config, state)
    if config.merge_equivalent:
        mi.parser.transform_merge_equivalent(config, state)
    if config.merge_meshes:
        mi.parser.transform_merge_meshes(config, state)
    scene = make_objects(config, state)
    if not isinstance(scene, mi.Scene):
        raise UsageError("the file holds no <scene>")
    return scene


def make_objects(config, state):
    """Make the root of a parsed state; a property that a plugin does not know is refused.

    Mitsuba refuses those that nobody has asked for. Whoever has read all in Python has asked for
    all: that is forgotten first.
    """
    for node in state.nodes:
        for key in list(node.props.keys()):
            node.props.mark_queried(key, False)
    return mi.parser.instantiate(config, state)


def _check_images(files: list[Path]) -> None:
    """Read all OpenEXR files once.

    Where they cannot be read Mitsuba 3.9 ends the process, without an exception, if it happens to
    read them in a thread of the pool that makes the scene.
    """
    for file in dict.fromkeys(files):
        if file.suffix.lower() == ".exr":
            try:
                mi.Bitmap(str(file))
            except RuntimeError as error:
                raise UsageError(f"{file}: not a whole image ({one_line(error)})") from error


class search_beside:
    """Context in which Mitsuba looks for a scene's files in the folder of ``path`` first.

    The folder is that of the path as given: a link to a scene elsewhere has its files beside it,
    or else beside its target.
    """

    def __init__(self, path: str) -> None:
        path_of("path", path)
        folders = (Path(os.path.abspath(path)).parent, Path(path).resolve().parent)
        self.folders = [str(folder) for folder in dict.fromkeys(folders)]

    def __enter__(self) -> None:
        self.before = mi.file_resolver()
        resolver = type(self.before)(self.before)
        for folder in reversed(self.folders):
            resolver.prepend(folder)
        mi.set_file_resolver(resolver)

    def __exit__(self, *_) -> None:
        mi.set_file_resolver(self.before)

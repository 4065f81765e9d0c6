"""What SCENE may be on the command line: a file, or a generator of ``manylights.scenes``.

A file is XML of Mitsuba, or a USD stage.

A generator is written ``NAME[:LIGHTS][,KEY=VALUE]...``, as in ``city:1000,kind=points``. The keys
are the arguments of the generator, and ``integrator``, ``max_depth``, ``rr_depth`` and
``hide_emitters``. Pictures have 160 x 90 pixels unless ``width`` and ``height`` say otherwise;
emission is stored in a texture where a generator offers it, since Mitsuba's own sampling finds no
light otherwise.

Samplers are those of ``bench.samplers``, whatever a scene has.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from manylights import lights, loading, scenes
from manylights.bench import methods, samplers
from manylights.errors import UsageError, one_line
from manylights.loading import integrators, ours
from manylights.loading.parsing import USD_ENDINGS
from manylights.threads import threads_for_files

WIDTH, HEIGHT = 160, 90

#: Keys of a generated scene that belong to its integrator.
INTEGRATOR_KEYS = ("max_depth", "rr_depth", "hide_emitters")

#: Generators that can store emission in a texture.
TEXTURED = ("city", "fog_open", "fog_rooms", "fog_street", "glossy", "rooms")


@dataclass
class MeasuredScene:
    """A scene in memory and what is to be known about it.

    Attributes:
        scene: Mitsuba's.
        kind: what its integrator computes.
        lights: number of lights, triangles of emissive meshes counted one by one.
        media: does it have participating media?
        sensors: for each sampler.
    """

    scene: Any
    kind: methods.Kind
    lights: int
    media: bool
    sensors: dict[str, Any]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, in pixels."""
        width, height = self.scene.sensors()[0].film().crop_size()
        return int(width), int(height)


@dataclass
class Source:
    """Where a scene comes from.

    Attributes:
        text: for people, a file's name with its folder, or the generator's call.
        name: short, without characters that are special in file names.
        family: the same for scenes that differ in the number of lights only.
        fingerprint: SHA-256 of all that the scene is made of.
        load: makes the scene.
    """

    text: str
    name: str
    family: str
    fingerprint: str
    load: Callable[[], MeasuredScene]


def find(
    text: str,
    defines: dict[str, str] | None = None,
    usd_options: loading.UsdOptions | None = None,
) -> Source:
    """Find the scene that ``text`` names, and check what can be checked without loading it.

    Args:
        text: a scene file or a call of a generator.
        defines: values for the ``<default>`` parameters of XML files. Default: none.
        usd_options: how USD stages are read. Default: as ``loading.UsdOptions()`` has it.

    Raises:
        UsageError: there is no such file or generator, or it does not accept its arguments.
    """
    if Path(text).suffix.lower() in (".xml", *USD_ENDINGS) or Path(text).is_file():
        stage = usd_options or loading.UsdOptions()
        is_stage = Path(text).suffix.lower() in USD_ENDINGS
        return _file(text, {} if is_stage else defines or {}, stage)
    if _parse_call(text)[0] not in scenes.names():
        raise UsageError(
            f"{text}: neither an XML file nor a USD stage nor a generator, those are "
            f"{', '.join(scenes.names())}"
        )
    return _generated(text)


def _file(path: str, defines: dict[str, str], stage: loading.UsdOptions) -> Source:
    try:
        with loading.search_beside(path), threads_for_files():
            files = loading.parse(path, defines, stage).files
    except RuntimeError as error:
        raise UsageError(f"{path}: {one_line(error)}") from error
    # The folder tells scenes apart that are all called scene.xml.
    folder, file_name = Path(os.path.abspath(path)).parts[-2:]
    text = f"{folder}/{file_name}"
    choices = {**defines, **asdict(stage)} if stage != loading.UsdOptions() else defines
    digest = hashlib.sha256(json.dumps(choices, sort_keys=True).encode())
    for file in files:
        digest.update(file.read_bytes())

    def load() -> MeasuredScene:
        try:
            return _load_file(path, defines, stage)
        except RuntimeError as error:
            raise UsageError(f"{path}: {one_line(error)}") from error

    stem = Path(path).stem
    name = _plain(folder if stem == "scene" else stem)
    return Source(text, name, name, digest.hexdigest(), load)


def _load_file(path: str, defines: dict[str, str], stage: loading.UsdOptions) -> MeasuredScene:
    with loading.search_beside(path), threads_for_files():
        parsed = loading.parse(path, defines, stage)
        plugin, parameters = "path", {}
        for node in integrators.leaf_integrators(parsed.state):
            plugin, parameters = node.props.plugin_name(), dict(node.props.items())
        media = any(node.type == mi.ObjectType.Medium for node in parsed.state.nodes)
        samplers.add_sensors(parsed.state)
        scene = loading.instantiate(parsed)
    return _describe(path, scene, plugin, parameters, media)


def _generated(text: str) -> Source:
    name, arguments, settings = _parse_call(text)
    # A small one of the same kind: names and values are checked before anything is measured.
    count = arguments.get("n_lights", 10)
    few = count if count > 1_000_000 else min(count, 10)
    _generate(text, name, {**arguments, "n_lights": few})
    content = json.dumps([name, arguments, settings], sort_keys=True, default=str)
    from manylights import __version__

    fingerprint = hashlib.sha256(f"{__version__} {content}".encode()).hexdigest()
    rest = [f"{key}={value}" for key, value in (*arguments.items(), *settings.items())]
    rest = [item for item in rest if not item.startswith("n_lights=")]

    def load() -> MeasuredScene:
        description = _generate(text, name, arguments)
        chosen = dict(description["integrator"])
        plugin = settings.get("integrator", chosen.pop("type"))
        chosen.update({key: settings[key] for key in INTEGRATOR_KEYS if key in settings})
        # Methods bring their own integrators.
        description["integrator"] = {"type": "direct"}
        media = "medium" in description["sensor"]
        return _describe(
            text, mi.load_dict(samplers.with_sensors(description)), plugin, chosen, media
        )

    return Source(text, _plain(text), _plain("-".join([name, *rest])), fingerprint, load)


def _parse_call(text: str) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Split a call into the generator's name, its arguments, and settings of the integrator."""
    head, *items = text.split(",")
    name, separator, count = head.partition(":")
    if separator and "=" in count:
        items, count = [count, *items], ""
    arguments: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    if count:
        if not count.isdigit():
            raise UsageError(f"{text}: {count!r} is not a number of lights")
        arguments["n_lights"] = int(count)
    for item in items:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise UsageError(f"{text}: write {item!r} as KEY=VALUE")
        target = settings if key in ("integrator", *INTEGRATOR_KEYS) else arguments
        target[key] = ours.parse_value(value)
    return name, arguments, settings


def _generate(text: str, name: str, arguments: dict[str, Any]) -> dict:
    generator = getattr(scenes, name)
    defaults: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}
    if name in TEXTURED:
        defaults["texture"] = True
    if "n_lights" not in inspect.signature(generator).parameters:
        arguments = {key: value for key, value in arguments.items() if key != "n_lights"}
    try:
        with _quiet():
            return generator(**{**defaults, **arguments})
    except (TypeError, ValueError) as error:
        raise UsageError(f"{text}: {one_line(error)}") from error


@contextmanager
def _quiet():
    """Keep Mitsuba from warning of textures brighter than 1, which are light here."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def _describe(
    text: str, scene, plugin: str, parameters: dict[str, Any], media: bool
) -> MeasuredScene:
    try:
        kind = methods.kind_of(plugin, parameters, media)
    except UsageError as error:
        raise UsageError(f"{text}: {error}") from error
    count = sum(lights.count_kinds(scene).values())
    sensors: dict[str, Any] = dict(zip(samplers.NAMES, scene.sensors()))
    return MeasuredScene(scene, kind, count, media, sensors)


def _plain(text: str) -> str:
    """Return the text with all but letters, digits, dots and underscores turned into hyphens."""
    return "".join(letter if letter.isalnum() or letter in "._" else "-" for letter in text)

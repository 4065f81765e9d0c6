"""Loads a scene with the integrator that was asked for."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi

from manylights.errors import UsageError, check, shown
from manylights.loading import integrators, light_groups, merging, ours, samplers
from manylights.loading.parsing import (
    ParsedScene,
    UsdOptions,
    check_file,
    instantiate,
    parse,
    parse_description,
    search_beside,
)
from manylights.threads import require_variant, threads_for_files


@dataclass
class LoadedScene:
    """A scene and what is known about it.

    Attributes:
        scene: Mitsuba's.
        integrator_count: how many integrators it nests.
        notes: what was said about reading it and choosing them.
        files: what it was read from, the scene file first.
        exposure: factor of the camera, which images are multiplied by.
        choices: what was chosen and is not in the files, by the name of the option.
        arguments: of ``load``, with which another process loads the same; empty if it was not read
            from a file.
    """

    scene: Any
    integrator_count: int
    notes: list[str]
    files: list[Path] = field(default_factory=list)
    exposure: float = 1.0
    choices: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)


def load(
    path: str,
    defines: dict[str, str] | None = None,
    integrator: str | None = None,
    settings: dict | None = None,
    usd_options: UsdOptions | None = None,
    sampler: str | None = None,
) -> LoadedScene:
    """Load a scene and choose its integrator (see ``integrators.choose``) and its sampler.

    Args:
        path: an XML file or a USD stage.
        defines: values for the ``<default>`` parameters of XML. Default: none.
        integrator: ``None`` (``direct``, ``path`` and ``volpath`` become ours), ``"keep"`` or a
            plugin's name.
        settings: parameters to set on the integrator. Default: none.
        usd_options: how a stage is read. Default: as ``UsdOptions()`` has it.
        sampler: ``None`` (``independent`` becomes ours), ``"keep"`` or a plugin's name.

    Raises:
        UsageError: (a ``ValueError``) no such file, or an argument that is something else.
        RuntimeError: Mitsuba cannot read or make the scene.
    """
    check_arguments(path, defines, integrator, settings, usd_options, sampler)
    with search_beside(path), threads_for_files():
        groups = light_groups.as_text((settings or {}).get(light_groups.PARAMETER, ""))
        parsed = parse(path, defines, usd_options, groups)
        loaded = _choose_and_make(parsed, integrator, settings or {}, sampler)
    loaded.choices["define"] = defines or {}
    if usd_options is not None and usd_options != UsdOptions():
        loaded.choices["usd"] = asdict(usd_options)
    loaded.arguments = {"path": path, "defines": defines, "integrator": integrator}
    loaded.arguments |= {"settings": settings, "usd_options": usd_options, "sampler": sampler}
    return loaded


def check_arguments(path, defines, integrator, settings, usd_options, sampler) -> None:
    """Raise ``UsageError`` for arguments that ``load`` refuses whatever the scene is."""
    for name, value in (("integrator", integrator), ("sampler", sampler)):
        check(name, value, value is None or isinstance(value, str), "the name of a plugin")
    for name, value, kind, what in (
        ("settings", settings, dict, "a dictionary"),
        ("usd_options", usd_options, UsdOptions, "UsdOptions"),
    ):
        check(name, value, value is None or isinstance(value, kind), what)
    check_file(path, defines, usd_options)
    if integrator not in (None, "keep"):
        integrators.check_settings(integrator, settings or {})


def load_description(
    description: dict, integrator: str | None = None, settings: dict | None = None
) -> LoadedScene:
    """Do the same with a dictionary as for ``mi.load_dict``."""
    kind = description.get("type")
    if kind != "scene":
        raise UsageError(f'scene: a dictionary of the type {shown(kind)}, must be "scene"')
    with threads_for_files():
        parsed = parse_description(description)
        return _choose_and_make(parsed, integrator, settings or {}, None)


def as_loaded(scene, integrator=None, added: dict | None = None) -> tuple[LoadedScene, object]:
    """Load whatever describes a scene, if it is not loaded yet.

    Args:
        scene: a path, a dictionary, an ``mi.Scene`` or a ``LoadedScene``.
        integrator: ``None``, ``"keep"``, a plugin's name, a dictionary or an ``mi.Integrator``.
        added: parameters to set on the integrator, too. Default: none.

    Returns:
        The scene, and the integrator to use in place of the scene's, ``None`` for the scene's.

    Raises:
        UsageError: either is something else, or there are parameters for what is made already.
    """
    require_variant()
    known = integrator is None or isinstance(integrator, (str, dict, mi.Integrator))
    check("integrator", integrator, known, "a name, a dictionary or an mi.Integrator")
    if isinstance(integrator, dict):
        named = isinstance(integrator.get("type"), str)
        check("integrator", integrator, named, 'a dictionary with the name of a plugin as "type"')
    made = isinstance(scene, (mi.Scene, LoadedScene))
    strict = [name for name, value in (added or {}).items() if not isinstance(value, ours.Wish)]
    if strict and (made or isinstance(integrator, mi.Integrator)):
        what = "scene" if made else "integrator"
        raise UsageError(f"{strict[0]}: the {what} is made already, set the parameter before")
    if made:
        if isinstance(scene, mi.Scene):
            scene = LoadedScene(scene, 1, [])
        return scene, _integrator(integrator)
    own = integrator if isinstance(integrator, mi.Integrator) else None
    settings = dict(integrator) if isinstance(integrator, dict) else {}
    name = settings.pop("type", None) if settings else ("keep" if own else integrator)
    settings = ours.joined(settings, {} if own else added or {})
    if isinstance(scene, dict):
        return load_description(scene, name, settings), own
    if isinstance(scene, (str, os.PathLike)):
        return load(os.fspath(scene), None, name, settings), own
    what = f"a path, a dictionary or an mi.Scene of the variant {mi.variant()}"
    raise UsageError(f"scene {shown(scene)}: must be {what}")


def _integrator(wanted):
    """Return an integrator that was asked for, ``None`` for that of the scene."""
    if wanted is None or wanted == "keep" or isinstance(wanted, mi.Integrator):
        return None if wanted == "keep" else wanted
    made = mi.load_dict({"type": wanted} if isinstance(wanted, str) else wanted)
    check("integrator", wanted, isinstance(made, mi.Integrator), "an integrator of Mitsuba or ours")
    return made


def _choose_and_make(
    parsed: ParsedScene, integrator: str | None, settings: dict, sampler: str | None
) -> LoadedScene:
    notes = parsed.notes + integrators.choose(parsed.state, integrator, settings)
    notes += samplers.choose(parsed.state, sampler)
    integrators.fix_block_size(parsed.state)
    nodes = parsed.state.nodes
    count = sum(node.type == mi.ObjectType.Integrator for node in nodes)
    notes += _merge_emitters(parsed)
    # Mitsuba makes one mesh of all that have the same material
    parsed.config.merge_meshes &= not merging.shows_indices(parsed.state)
    choices = {"integrator": integrator, "set": settings}
    choices |= {"sampler": sampler} if sampler else {}
    scene = instantiate(parsed)
    if not scene.emitters():
        notes.append("lights: the scene has none, its image is black")
    return LoadedScene(scene, max(count, 1), notes, parsed.files, parsed.exposure, choices)


def _merge_emitters(parsed: ParsedScene) -> list[str]:
    """Merge emissive meshes where that changes nothing but time, and say so."""
    merged = merging.merge_parsed(parsed.config, parsed.state)
    shapes = sum(len(ids) for ids in merged.values())
    return [f"emitters: {shapes} meshes merged into {len(merged)}"] if merged else []

"""Loads a scene with the integrator that was asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from manylights.loading import integrators, merging
from manylights.loading.parsing import (
    ParsedScene,
    UsdOptions,
    instantiate,
    parse,
    search_beside,
)
from manylights.threads import threads_for_files


@dataclass
class LoadedScene:
    """A scene and what is known about it.

    Attributes:
        scene: Mitsuba's.
        integrator_count: how many integrators it nests.
        notes: what was said about reading it and choosing them.
        files: what it was read from, the scene file first.
        exposure: factor of the camera, which images are multiplied by.
    """

    scene: object
    integrator_count: int
    notes: list[str]
    files: list[Path] = field(default_factory=list)
    exposure: float = 1.0


def load(
    path: str,
    defines: dict[str, str] | None = None,
    integrator: str | None = None,
    settings: dict | None = None,
    usd_options: UsdOptions | None = None,
) -> LoadedScene:
    """Load a scene and choose its integrator (see ``integrators.choose``).

    Args:
        path: an XML file or a USD stage.
        defines: values for the ``<default>`` parameters of XML. Default: none.
        integrator: ``None`` (``direct``, ``path`` and ``volpath`` become ours), ``"keep"`` or a
            plugin's name.
        settings: parameters to set on the integrator. Default: none.
        usd_options: how a stage is read. Default: as ``UsdOptions()`` has it.
    """
    with search_beside(path), threads_for_files():
        parsed = parse(path, defines, usd_options)
        notes = parsed.notes + integrators.choose(parsed.state, integrator, settings or {})
        integrators.fix_block_size(parsed.state)
        nodes = parsed.state.nodes
        count = sum(node.type == mi.ObjectType.Integrator for node in nodes)
        notes += _merge_emitters(parsed)
        scene = instantiate(parsed)
        return LoadedScene(scene, max(count, 1), notes, parsed.files, parsed.exposure)


def _merge_emitters(parsed: ParsedScene) -> list[str]:
    """Merge emissive meshes where that changes nothing but time, and say so."""
    merged = merging.merge_parsed(parsed.config, parsed.state)
    shapes = sum(len(ids) for ids in merged.values())
    return [f"emitters: {shapes} meshes merged into {len(merged)}"] if merged else []

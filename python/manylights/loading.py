"""Sets the variant and loads XML scenes, with the integrator that was asked for."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi

from manylights import integrators, merging
from manylights.errors import UsageError, one_line
from manylights.threads import threads_for_files


@dataclass
class LoadedScene:
    """A scene and what is known about it.

    Attributes:
        scene: Mitsuba's.
        integrator_count: how many integrators it nests.
        notes: what was said about choosing them.
        files: what it was read from, the scene file first.
    """

    scene: object
    integrator_count: int
    notes: list[str]
    files: list[Path] = field(default_factory=list)


OLDEST_LLVM = 17
"""Kernels of Dr.Jit 1.5 abort the process with an older LLVM on x86-64."""


def has_backend(backend: dr.JitBackend) -> bool:
    """Can kernels be compiled for this backend on this machine?"""
    if not dr.has_backend(backend):
        return False
    return backend != dr.JitBackend.LLVM or int(dr.detail.llvm_version()[0]) >= OLDEST_LLVM


def default_variant() -> str:
    """Return ``llvm_ad_rgb`` where a usable libLLVM is installed, else ``scalar_rgb``."""
    has_llvm = "llvm_ad_rgb" in mi.variants() and has_backend(dr.JitBackend.LLVM)
    return "llvm_ad_rgb" if has_llvm else "scalar_rgb"


def set_variant(name: str | None) -> str:
    """Set Mitsuba's variant, ``None`` for the default one, and return its name.

    Raises:
        UsageError: Mitsuba does not have it, or the machine lacks LLVM or CUDA.
    """
    variant = name or default_variant()
    if variant not in mi.variants():
        raise UsageError(f"--variant {variant}: unknown, choose from {', '.join(mi.variants())}")
    needs = (
        ("llvm", dr.JitBackend.LLVM, f"LLVM {OLDEST_LLVM} or later (on Debian: libllvm19)"),
        ("cuda", dr.JitBackend.CUDA, "an NVIDIA driver and GPU"),
    )
    for prefix, backend, what in needs:
        if variant.startswith(prefix) and not has_backend(backend):
            raise UsageError(f"--variant {variant}: needs {what}; a scalar variant does without")
    mi.set_variant(variant)
    return variant


def parse(path: str, defines: dict[str, str]):
    """Parse an XML scene into ``(config, state)`` of ``mi.parser``, upgraded, not transformed.

    Args:
        path: the XML file.
        defines: values for the scene's ``<default>`` parameters, by name.

    Raises:
        UsageError: there is no such file.
        RuntimeError: Mitsuba cannot read it.
    """
    if not Path(path).is_file():
        raise UsageError(f"{path}: no such file")
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_file(config, str(path), **defines)
    mi.parser.transform_upgrade(config, state)
    return config, state


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


def instantiate(config, state):
    """Make Mitsuba's objects of a parsed scene, inside of ``search_beside``.

    Raises:
        UsageError: the file describes something that is not a scene, or an image is not whole.
        RuntimeError: Mitsuba cannot make something.
    """
    _check_images(files_of(state))
    mi.parser.transform_resolve(config, state)
    if config.merge_equivalent:
        mi.parser.transform_merge_equivalent(config, state)
    if config.merge_meshes:
        mi.parser.transform_merge_meshes(config, state)
    scene = mi.parser.instantiate(config, state)
    if not isinstance(scene, mi.Scene):
        raise UsageError("the file holds no <scene>")
    return scene


def _merge_emitters(config, state) -> list[str]:
    """Merge emissive meshes where that changes nothing but time, and say so."""
    merged = merging.merge_parsed(config, state)
    shapes = sum(len(ids) for ids in merged.values())
    return [f"emitters: {shapes} meshes merged into {len(merged)}"] if merged else []


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

    If ``path`` is a symbolic link, its own folder comes before that of the file it leads to.
    """

    def __init__(self, path: str) -> None:
        self.folders = [Path(path).absolute().parent, Path(path).resolve().parent]

    def __enter__(self) -> None:
        self.before = mi.file_resolver()
        resolver = type(self.before)(self.before)
        for folder in reversed(self.folders):
            resolver.prepend(str(folder))
        mi.set_file_resolver(resolver)

    def __exit__(self, *_) -> None:
        mi.set_file_resolver(self.before)


def load(
    path: str,
    defines: dict[str, str] | None = None,
    integrator: str | None = None,
    settings: dict | None = None,
) -> LoadedScene:
    """Load an XML scene and choose its integrator (see ``integrators.choose``).

    Args:
        path: the XML file.
        defines: values for the scene's ``<default>`` parameters. Default: none.
        integrator: ``None`` (``direct``, ``path`` and ``volpath`` become ours), ``"keep"`` or a
            plugin's name.
        settings: parameters to set on the integrator. Default: none.
    """
    with search_beside(path), threads_for_files():
        config, state = parse(path, defines or {})
        files = files_of(state)
        notes = integrators.choose(state, integrator, settings or {})
        integrators.fix_block_size(state)
        count = sum(node.type == mi.ObjectType.Integrator for node in state.nodes)
        notes += _merge_emitters(config, state)
        return LoadedScene(instantiate(config, state), max(count, 1), notes, files)

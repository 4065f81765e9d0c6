"""Opens a stage: one error that names the file, or notes that group what did not compose."""

from __future__ import annotations

import contextlib
import math
import os
import re
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdUtils

from manylights.errors import UsageError, number, one_line
from manylights.usd.context import Notes

#: Files with notes of their own; further missing ones share one.
NAMED_FILES = 4

#: Extensions of scene files, for the message about a file of another kind.
EXTENSIONS = (".usd", ".usda", ".usdc", ".usdz")


class StageError(UsageError, ValueError):
    """A stage cannot be read; the text names file and prim."""


def open_stage(path, notes: Notes) -> Usd.Stage:
    """Open a stage and note what is missing in it.

    Args:
        path: of a ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        notes: is given at most :data:`NAMED_FILES` + 1 notes about missing files, one about cycles
            and one about other errors of composition.

    Raises:
        StageError: there is no such file, it is no stage, or it is broken.
    """
    path = os.fspath(path)
    if not Path(path).is_file() and "[" not in path:
        kind = "is a folder" if Path(path).is_dir() else "no such file"
        raise StageError(f"{path}: {kind}; expected a stage ({', '.join(EXTENSIONS)})")
    extension = Path(path.rstrip("]")).suffix.lstrip(".")
    if not extension or not Sdf.FileFormat.FindByExtension(extension):
        raise StageError(f"{path}: not a stage; expected {', '.join(EXTENSIONS)}")
    stage = Usd.Stage.Open(path)
    _note_composition(stage, path, notes)
    return stage


def layer_files(stage: Usd.Stage) -> list[str]:
    """Return the files of the layers in use, the root layer's first, each once."""
    root = stage.GetRootLayer()
    layers = [root, *stage.GetUsedLayers()]
    # Layers inside of an archive are named ARCHIVE[LAYER]
    paths = [layer.realPath.partition("[")[0] for layer in layers if not layer.anonymous]
    return [path for path in dict.fromkeys(paths) if os.path.isfile(path)]


@contextlib.contextmanager
def guarded(path):
    """Keep usd-core's warnings off stderr; turn what it raises into an error about the file."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except Tf.ErrorException as error:
        raise StageError(f"{os.fspath(path)}: {_reason(str(error))}") from None
    except (UnicodeDecodeError, MemoryError) as error:
        # Names and sizes of a damaged file
        raise StageError(f"{os.fspath(path)}: broken: {one_line(error)}") from None
    finally:
        delegate.TakeUncoalescedDiagnostics()


def targets_of(prim: Usd.Prim, name: str) -> list[Sdf.Path]:
    """Return the targets of a prim's relationship, none if it has no such one."""
    relation = prim.GetRelationship(name)
    return relation.GetForwardedTargets() if relation else []


def time_of(stage: Usd.Stage, time: float | None) -> Usd.TimeCode:
    """Return the time to read at: as asked for, else the authored start, else the default."""
    if isinstance(time, Usd.TimeCode):
        return time
    if time is not None:
        return Usd.TimeCode(number("time", time, math.isfinite, "a finite number"))
    if stage.HasAuthoredMetadata("startTimeCode"):
        return Usd.TimeCode(stage.GetStartTimeCode())
    return Usd.TimeCode.Default()


def _reason(text: str) -> str:
    """Return the first message in what usd-core raised."""
    found = re.findall(r": '(.*?)'\s*(?=Error in|$)", text, flags=re.DOTALL)
    reasons = [" ".join(reason.split()) for reason in found]
    specific = [reason for reason in reasons if not reason.startswith("Failed to open layer")]
    return specific[0] if specific else "cannot be read: broken, truncated or of another kind"


def _note_composition(stage: Usd.Stage, path: str, notes: Notes) -> None:
    missing: dict[str, list] = {}
    for error in stage.GetCompositionErrors():
        text = " ".join(str(error).split())
        prim = str(error.rootSite.path)
        where = path if prim in ("", "/") else f"{path}{prim}" if prim[0] != "/" else prim
        name = type(error).__name__
        asset = re.search(r"(?:asset|sublayer) @([^@]+)@", text)
        if "Cycle" in name:
            notes.add("cycle", f"a cycle in the composition was cut: {text}", where)
        elif asset and name in ("ErrorInvalidAssetPath", "ErrorInvalidSublayerPath"):
            reason = text.partition(" -- ")[2].removesuffix("skipping.").rstrip("; ")
            missing.setdefault(asset[1], [where, 0, reason])[1] += 1
        else:
            notes.add("composition", f"a part of the stage does not compose: {text}", where)
    for index, (asset, (where, count, reason)) in enumerate(missing.items()):
        if index == NAMED_FILES and len(missing) > NAMED_FILES + 1:
            rest = list(missing.values())[NAMED_FILES:]
            text = f"{len(rest)} more files are missing or unreadable, the first of them {asset}"
            notes.add("files", text, where, sum(number for _, number, _ in rest))
            break
        notes.add(asset, _missing(asset, reason), where, count)


def _missing(asset: str, reason: str) -> str:
    if asset.endswith(".mtlx"):
        return (
            f"{asset}: MaterialX files need pip install 'manylights[usd-mtlx]' in place of usd-core"
        )
    if reason:
        return f"{asset} cannot be read: {reason}"
    return f"{asset} is missing" if not Path(asset).is_file() else f"{asset} cannot be read"

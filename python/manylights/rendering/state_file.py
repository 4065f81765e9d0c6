"""The file of a state: what a render has so far, as a checkpoint, as a part, or merged of parts.

It is an OpenEXR image that any viewer shows: the picture so far in its own channels, the parts of
the film's sums in channels of their own (``output.channels``), and in the attributes
``manylights.*`` what was rendered and learnt, as JSON. It is written under another name and then
renamed: whoever is killed while writing leaves the one before. Reading runs nothing: numbers and
texts are parsed, and their sizes checked.

Finished images have the attributes, too, but no sums.
"""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from manylights import files
from manylights.errors import UsageError, one_line
from manylights.output import channels, exr
from manylights.rendering import metadata
from manylights.rendering.develop import WEIGHT, picture
from manylights.rendering.job import FORMAT
from manylights.rendering.parts import Part, Run
from manylights.rendering.state import State
from manylights.rendering.sums import PARTS, Sums
from manylights.rendering.targets import History

#: What is learnt has 42 MB at most; more is no file of ours.
MOST_LEARNT = 2**26

#: More steps take longer than anybody waits.
MOST_STEPS = 2**26


@dataclass
class Saved:
    """What a file holds.

    Attributes:
        path: of the file.
        facts: of the job (``Job.facts``), and others of the state.
        runs: which steps there are.
        state: ``None`` in a finished image.
        shown: names of the channels of the image.
        command: words of the command line that rendered it, without the part; empty if none did.
        standard: attributes that are those of the OpenEXR standard (``metadata.STANDARD``).
    """

    path: Path
    facts: dict[str, Any]
    runs: list[Run]
    state: State | None
    shown: list[str]
    command: list[str]
    standard: dict[str, Any] = field(default_factory=dict)


def write(saved: Saved) -> Path:
    """Write a file with sums."""
    state, facts = saved.state, saved.facts
    summed = state.channels
    shown = [index for index, name in enumerate(summed) if name != WEIGHT]
    image = picture(state.rough_total(facts["adjoint"]), summed)[..., shown]
    planes = {summed[index]: image[..., at] for at, index in enumerate(shown)}
    for prefix, part in zip(channels.sums(len(state.sums)), _parts(state.sums)):
        planes |= {prefix + name: part[..., at] for at, name in enumerate(summed)}
    done = {"history": asdict(state.history), "channels": summed, "shown": saved.shown}
    done |= {"learnt": _packed(state.learnt), "sequences": len(state.sums)}
    done["runs"] = [[run.part.number, run.part.count, run.done] for run in saved.runs]
    done |= {"processors": state.processors, "command": saved.command}
    facts = {**facts, **done, "samples_done": state.history.spp}
    facts["checksum"] = _checksum(facts, state.sums)
    return exr.write(saved.path, planes, saved.standard | signature(facts, state.history.spp))


def signature(facts: dict[str, Any], samples: int) -> dict[str, str]:
    """Return facts and the number of samples per pixel as the attributes of a file."""
    told = {**facts, "samples_done": samples}
    return {exr.OURS + name: json.dumps(value) for name, value in told.items()}


def read(path: Path, prefix: str, remedy: str) -> tuple[Saved, dict[str, np.ndarray]]:
    """Read a file of a state or a finished image, and return it and its channels.

    Args:
        path: the file.
        prefix: what it should be, for messages: "checkpoint".
        remedy: what to do about another one, for messages.

    Raises:
        UsageError: not such a file, or not a whole one.
    """
    files.require(path)
    try:
        planes, attributes = exr.read(path)
        facts = {
            name[len(exr.OURS) :]: exr.fact(value)
            for name, value in attributes.items()
            if name.startswith(exr.OURS)
        }
        if "samples_done" in facts:
            saved = _saved(path, planes, facts)
            named = (name for name in metadata.STANDARD if name in attributes)
            saved.standard = {name: attributes[name] for name in named}
            return saved, planes
    except (UsageError, ValueError, KeyError, TypeError, AttributeError, zlib.error) as error:
        what = f"{type(error).__name__}: " if isinstance(error, (KeyError, TypeError)) else ""
        reason = one_line(error).removeprefix(f"{path}: ")
        text = f"{path}: not a whole {prefix}{remedy} ({what}{reason})"
        raise UsageError(text) from error
    raise UsageError(f"{path}: not a {prefix} of manylights{remedy}")


def _saved(path: Path, planes: dict[str, np.ndarray], facts: dict[str, Any]) -> Saved:
    if facts["format"] != FORMAT:
        version = facts.get("version")
        raise ValueError(f"format {facts['format']} and not {FORMAT}, written by {version}")
    steps = facts["step_count"]
    if steps is not None and not 1 <= steps <= MOST_STEPS:
        raise ValueError(f"{steps} steps")
    if "channels" not in facts:
        if not facts["seeds"] or not 1 <= facts["samples_done"] < 2**53:
            raise ValueError(f"{facts['samples_done']} samples of the seeds {facts['seeds']}")
        return Saved(path, facts, [], None, [], [])
    runs = [_run(run, steps) for run in facts["runs"]]
    state = _state(planes, facts)
    if _checksum(facts, state.sums) != facts["checksum"]:
        raise ValueError("checksum")
    command = [str(word) for word in facts["command"]]
    return Saved(path, facts, runs, state, list(facts["shown"]), command)


def _run(numbers: list[int], steps: int | None) -> Run:
    number, count, done = numbers
    part = Part.of((number, count))
    if type(done) is not int or not 0 <= done <= (2**32 if steps is None else part.steps(steps)):
        raise ValueError(f"{done} steps of {part.words()}")
    return Run(part, done)


def _state(found: dict[str, np.ndarray], facts: dict[str, Any]) -> State:
    prefixes = channels.sums(facts["sequences"])
    missing = [p + n for p in prefixes for n in facts["channels"] if p + n not in found]
    if missing or not facts["channels"]:
        raise ValueError(f"no channel {missing[0]}" if missing else "no channels")
    parts = [
        np.stack([found[prefix + name] for name in facts["channels"]], axis=-1)
        for prefix in prefixes
    ]
    sums = [Sums(np.stack(parts[at : at + PARTS])) for at in range(0, len(parts), PARTS)]
    history = History(**facts["history"])
    ahead = [number for number in history.ahead if type(number) is int and number > history.steps]
    if ahead != sorted(set(history.ahead)):
        raise ValueError(f"the steps {history.ahead} beyond {history.steps}")
    if len(history.samples) != len(sums):
        raise ValueError(f"{len(history.samples)} numbers of samples and {len(sums)} sequences")
    learnt, processors = _unpacked(facts["learnt"]), list(facts["processors"])
    return State(sums, history, list(facts["channels"]), learnt, processors)


def _parts(sums: list[Sums]):
    """Yield the parts of the sums of all sequences, zeros where there are none yet."""
    zeros = np.zeros_like(sums[0].parts)
    for one in sums:
        yield from zeros if one.parts is None else one.parts


def _checksum(facts: dict[str, Any], sums: list[Sums]) -> int:
    """Return CRC-32 of facts and sums: files travel."""
    facts = {name: value for name, value in facts.items() if name != "checksum"}
    result = zlib.crc32(json.dumps(facts, sort_keys=True).encode())
    for part in _parts(sums):
        result = zlib.crc32(np.ascontiguousarray(part), result)
    return result


def _packed(counts: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(counts.astype("<u4").tobytes())).decode()


def _unpacked(text: str) -> np.ndarray:
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(base64.b64decode(text), MOST_LEARNT)
    if not unpacker.eof:
        raise ValueError("what was learnt does not end")
    return np.frombuffer(data, "<u4").astype(np.uint32)

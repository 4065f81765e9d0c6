"""What is wrong with the arguments of a render whatever its scene: said before that is loaded."""

from __future__ import annotations

from typing import Any

from manylights import files
from manylights.errors import UsageError, argument, check, typed
from manylights.rendering.parts import Part


def check_together(
    part: Part | None, until_noise: Any, seconds: Any, learnt: Any, client: Any, ship: bool = False
) -> None:
    """Check that arguments of ``render`` go together.

    Args:
        part, until_noise, seconds, learnt, client, ship: those of ``render``; ``None`` is not
            given.

    Raises:
        UsageError: two that exclude each other, one without which another is of no use, or there
            is no file ``learnt``.
    """
    if part is not None and (until_noise is not None or seconds is not None):
        target = "noise" if until_noise is not None else "time"
        raise UsageError(
            f"{part.words()}: needs a fixed number of samples. With a {target} as the target each "
            "step depends on what all those before have given"
        )
    if client is not None and seconds is not None:
        raise UsageError(
            "workers: need a number of samples or a noise. With a time as the target each step "
            "depends on how long the one before took"
        )
    if ship and client is None:
        name = typed("ship True", "--ship")
        raise UsageError(f"{name}: must be given with {argument('client')}")
    if learnt is not None:
        check("learnt", learnt, part is not None, f"given with {argument('part')}")
        files.require(files.path_of("learnt", learnt), f"{argument('learnt')} ")

"""Groups of lights, as users name them: ``key=lamp_*,windows=facade``.

The plugins read and check the text, and decide which light is in which group. Here is what has to
be known before there are lights: which of them may become one mesh.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fnmatch import fnmatchcase

from manylights.errors import UsageError

#: The parameter of our integrators.
PARAMETER = "light_groups"


def as_text(groups: str | Mapping[str, str | list[str]]) -> str:
    """Return the value of the parameter for a text, or for patterns by the names of groups.

    Args:
        groups: ``"key=lamp_*,windows=facade"``, or ``{"key": "lamp_*", "windows": ["facade"]}``.

    Raises:
        UsageError: something else.
    """
    if isinstance(groups, str):
        return groups
    if not isinstance(groups, Mapping):
        raise UsageError(f"light_groups {groups!r}: must be a text or a dictionary")
    entries = []
    for name, patterns in groups.items():
        patterns = [patterns] if isinstance(patterns, str) else patterns
        if not isinstance(patterns, (list, tuple)) or not patterns:
            raise UsageError(f"light_groups: the group {name} is {patterns!r}, and no pattern")
        for pattern in patterns:
            if "," in str(pattern):
                raise UsageError(f"light_groups: the pattern {pattern} of {name} has a comma")
            entries.append(f"{name}={pattern}")
    return ",".join(entries)


def of_integrator(integrator) -> str:
    """Return the value of the parameter of an integrator, or of one that it nests; "" for none."""
    found = re.search(rf'{PARAMETER} = "(.*)"', str(integrator))
    return found[1] if found else ""


def are_named(scene) -> bool:
    """Has a light of a scene an id, or its shape? So it is, too, if there are no lights."""
    emitters = scene.emitters()
    shapes = (emitter.get_shape() for emitter in emitters)
    ids = (emitter.id() or (shape and shape.id()) for emitter, shape in zip(emitters, shapes))
    return not emitters or any(ids)


def entry_of(groups: str, *names: str) -> int | None:
    """Return the number of the entry that a light with these names belongs to, None for none.

    Of paths of prims, which begin with ``/``, the last part is a name, too, and what follows ``#``
    tells several lights of a prim apart.

    Of a text that is wrong anything; the plugins refuse it.
    """
    for path in [name for name in names if name.startswith("/")]:
        path = path.partition("#")[0]
        names = (*names, path, path.rpartition("/")[2])
    for index, entry in enumerate(groups.split(",")):
        pattern = entry.partition("=")[2]
        if any(fnmatchcase(name, pattern) for name in names):
            return index
    return None

"""Which group of lights each light of a stage belongs to, by the paths of prims.

What the reader makes of lights is called by those paths, so that the plugins find the groups
again, and becomes one mesh only where the group is the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd

from manylights.errors import UsageError, argument
from manylights.loading.light_groups import entry_of
from manylights.output.light_groups import REST

#: Paths that an error lists.
MOST_PATHS = 8


@dataclass(frozen=True)
class GroupMember:
    """A light in a group.

    Attributes:
        entry: which of the text, ``None`` for the lights of none.
        name: a path by which the plugins come to the same entry.
    """

    entry: int | None
    name: str


class LightGroups:
    """The groups that a text names, empty if it is.

    Attributes:
        text: as the parameter ``light_groups`` of the integrators.
    """

    def __init__(self, text: str = "") -> None:
        self.text = text
        self._used: set[int | None] = set()
        self._paths: dict[str, None] = {}

    def __bool__(self) -> bool:
        return bool(self.text)

    def entry_of(self, path: str) -> int | None:
        """Return the first entry that fits a path, or the name of its prim."""
        return entry_of(self.text, path)

    def of(
        self, prim: Usd.Prim, others: Iterable[Sdf.Path] = (), shines: bool = True
    ) -> GroupMember | None:
        """Return where a light belongs, ``None`` if there are no groups.

        Args:
            prim: the light.
            others: paths of prims that it is known by, too: instancers, what it shines from.
            shines: or is it of no group's use?
        """
        if not self:
            return None
        paths = [str(prim.GetPath()), *map(str, others)]
        found = [(entry, path) for path in paths if (entry := self.entry_of(path)) is not None]
        entry, name = min(found, key=lambda pair: pair[0], default=(None, paths[0]))
        if shines:
            self._used.add(entry)
            self._paths.setdefault(paths[0])
        return GroupMember(entry, name)

    def check(self) -> None:
        """Raise ``UsageError`` for an entry that no light is in; the plugins check the grammar."""
        entries = [entry.partition("=") for entry in self.text.split(",")]
        if not self or not all(group and pattern for group, _, pattern in entries):
            return
        for index, (group, _, pattern) in enumerate(entries):
            if index not in self._used:
                raise UsageError(
                    f'{argument("light_groups")}: "{group}={pattern}" matches no light that an '
                    "entry before it has not. Patterns are for the paths of prims (* fits / too) "
                    f"or their names. The stage has {self._listed()}"
                )

    def check_environment(self, members: Iterable[GroupMember | None]) -> None:
        """Raise ``UsageError`` if the domes that become one environment are in several entries."""
        entries, found = self.text.split(","), {}
        for member in filter(None, members):
            name = REST if member.entry is None else entries[member.entry]
            found.setdefault(name, member.name)
        if len(found) > 1:
            listed = " and ".join(f"{path} in {name}" for name, path in found.items())
            raise UsageError(
                f"{argument('light_groups')}: {listed}: the domes of a stage become one "
                "environment, which one entry has to fit"
            )

    def _listed(self) -> str:
        paths = list(self._paths)
        more = ", ..." if len(paths) > MOST_PATHS else ""
        lights = f"{len(paths)} light" + ("s" if len(paths) != 1 else "")
        return f"{lights}: {', '.join(paths[:MOST_PATHS])}{more}" if paths else "no light"


def split(members: list[GroupMember | None], which: np.ndarray) -> Iterator[tuple]:
    """Yield one member of each entry, and which elements are of that entry.

    Args:
        members: of some lights.
        which: ``(n,)``, the light of each element.
    """
    if not any(members):
        yield None, slice(None)
        return
    entries = [-1 if member.entry is None else member.entry for member in members]
    of_element = np.array(entries)[which]
    for entry in np.unique(of_element):
        chosen = of_element == entry
        yield members[which[chosen][0]], chosen

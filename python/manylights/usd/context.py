"""What all parts of the USD reader share: the stage, the time, the choices, and the notes."""

from __future__ import annotations

from dataclasses import dataclass, field

from pxr import Usd, UsdGeom

from manylights.usd.light_groups import LightGroups


@dataclass
class Note:
    """Something of a stage that was not carried over, or not as it is.

    Attributes:
        kind: what tells it from others, for example ``"ies"``.
        message: a sentence about one case.
        count: how often it occurred.
        prim: path of the first prim (or file) that it is about.
    """

    kind: str
    message: str
    prim: str
    count: int = 1

    @property
    def text(self) -> str:
        """The sentence, how often, and the first prim's path."""
        times = f"{self.count} times, first at" if self.count > 1 else "1 time, at"
        return f"{self.message} ({times} {self.prim})"


class Notes(list):
    """One :class:`Note` a kind, in the order of their first occurrence."""

    def add(self, kind: str, message: str, prim, count: int = 1) -> None:
        """Note ``count`` more cases of a kind; the first one's message and prim stay."""
        path = str(prim.GetPath()) if hasattr(prim, "GetPath") else str(prim)
        for note in self:
            if note.kind == kind:
                note.count += count
                return
        self.append(Note(kind, message, path, count))


@dataclass
class Context:
    """A stage and the choices with which it is read.

    Attributes:
        stage: opened, composed.
        time: at which attributes are read.
        notes: what was not carried over.
        purposes: of the prims that are read.
        subdivision: levels for meshes without an authored scheme; ``None``: the cage.
        legacy_lights: read the inputs of lights from before USD 21.05?
        blender_light_units: are lights as Blender exports them?
        light_groups: which lights may become one.
        color_primvar: what colors of surfaces are read from.
    """

    stage: Usd.Stage
    time: Usd.TimeCode
    notes: Notes = field(default_factory=Notes)
    purposes: tuple[str, ...] = ("default", "render")
    subdivision: int | None = None
    legacy_lights: bool = False
    blender_light_units: bool = False
    light_groups: LightGroups = field(default_factory=LightGroups)
    color_primvar: str = "displayColor"

    def value(self, attribute, fallback=None):
        """Return an attribute's value, ``fallback`` if it has none or is blocked.

        At a default time attributes that have only samples give their earliest one.
        """
        if not attribute:
            return fallback
        time = self.time
        if time.IsDefault() and attribute.GetNumTimeSamples():
            # Without an authored default, Get would give the schema's fallback
            source = attribute.GetResolveInfo(time).GetSource()
            if source in (Usd.ResolveInfoSourceFallback, Usd.ResolveInfoSourceNone):
                time = Usd.TimeCode.EarliestTime()
        value = attribute.Get(time)
        return fallback if value is None else value

    def up_axis(self) -> str:
        """Return the axis that points up, ``"Y"`` or ``"Z"``."""
        axis = str(UsdGeom.GetStageUpAxis(self.stage))
        if axis in ("Y", "Z"):
            return axis
        self.notes.add("upAxis", f"upAxis {axis} is neither Y nor Z and was read as Y", "/")
        return "Y"

    def __post_init__(self) -> None:
        self.transforms = UsdGeom.XformCache(self.time)

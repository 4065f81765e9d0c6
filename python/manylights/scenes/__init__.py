"""Procedural scenes with 1 to 1,000,000 lights, as dictionaries for ``mi.load_dict``::

    import mitsuba as mi
    import manylights

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_dict(manylights.scenes.city(100_000, seed=1))

The same arguments give the same scene. Generators that make meshes need a variant to be set, and
what they return belongs to that variant.
"""

from __future__ import annotations

from manylights.scenes._adversarial import (
    behind_wall,
    bright_far,
    coincident,
    cut_boundary,
    narrow_spots,
    on_emitter,
    twelve_decades,
)
from manylights.scenes._city import city
from manylights.scenes._fog import fog_open, fog_rooms, fog_street
from manylights.scenes._gallery import bulbs, glossy, open_plane, rooms
from manylights.scenes._house import house

__all__ = [
    "behind_wall",
    "bright_far",
    "bulbs",
    "city",
    "coincident",
    "cut_boundary",
    "fog_open",
    "fog_rooms",
    "fog_street",
    "glossy",
    "house",
    "names",
    "narrow_spots",
    "on_emitter",
    "open_plane",
    "rooms",
    "twelve_decades",
]


def names() -> list[str]:
    """Return the names of all generators."""
    return [name for name in __all__ if name != "names"]

"""From a file to Mitsuba's scene: parse, choose the integrator, merge lamps, make the objects.

- ``variants``: which of Mitsuba's variants this machine can run;
- ``parsing``: XML or USD to Mitsuba's parsed form, and from there to objects;
- ``ours``: names and parameters of our integrators;
- ``integrators``: replaces Mitsuba's integrators by ours and sets parameters;
- ``light_groups``: names of groups of lights, which are merged within a group alone;
- ``samplers``: replaces Mitsuba's sampler by ours;
- ``merging``: makes one mesh of many emissive ones;
- ``load``: all of it, for the command line.
"""

from manylights.loading import light_groups
from manylights.loading.load import LoadedScene, as_loaded, check_arguments, load
from manylights.loading.parsing import (
    ParsedScene,
    UsdOptions,
    files_of,
    instantiate,
    parse,
    search_beside,
)
from manylights.loading.variants import default_variant, has_backend, set_variant

__all__ = [
    "LoadedScene",
    "ParsedScene",
    "UsdOptions",
    "as_loaded",
    "check_arguments",
    "default_variant",
    "files_of",
    "has_backend",
    "instantiate",
    "light_groups",
    "load",
    "parse",
    "search_beside",
    "set_variant",
]

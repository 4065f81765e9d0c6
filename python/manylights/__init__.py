"""Light-tree rendering of scenes with very many lights, as plugins for Mitsuba 3.

Importing this package makes Mitsuba find the plugins ``manylights_direct``,
``manylights_volpath`` and ``manylights_sobol``::

    import mitsuba as mi
    import manylights

    mi.set_variant("llvm_ad_rgb")
    image = mi.render(mi.load_file("scene.xml"))

The order of ``import manylights`` and ``mi.set_variant`` does not matter: Mitsuba has one search
path for the whole process and reads it whenever a scene asks for a plugin.

``manylights.plugin_dir()`` is the folder for ``mitsuba -a``; ``manylights.render`` has all that the
command ``manylights render`` has, ``manylights.merge`` adds what several machines have rendered,
and ``manylights.mix`` makes groups of lamps brighter or darker afterwards; ``manylights.scenes``
generates scenes; ``manylights.power_sampling(scene)`` makes Mitsuba's own integrators choose
emitters by power, for comparisons. ``manylights.merge_emitters(description)`` makes scenes with
thousands of separate lamps start in seconds. ``manylights.usd.load(path)`` reads USD stages, with
``usd-core``.

What is where, each using only those before it:

- ``errors``, ``files``, ``threads``, ``progress``: what all parts of the command need;
- ``output``: images and the channels of their files;
- ``scenes``: generators of scenes;
- ``loading``: from a file to Mitsuba's scene, with our integrator; ``usd``: the reader of USD;
- ``power``, ``lights``: power of emitters; numbers about the lights of a scene and their tree;
- ``rendering``: a job in steps, with targets and checkpoints;
- ``bench``, ``report``: measures methods, and makes pages of what was measured;
- ``cli``: the command ``manylights``, a file for each of its commands.
"""

from __future__ import annotations

import importlib

from manylights._plugins import REQUIRED_MITSUBA, plugin_dir, register

register()

# These need the right Mitsuba, which register() checks.
from manylights import scenes  # noqa: E402
from manylights.loading.merging import merge_emitters  # noqa: E402
from manylights.power import power_sampling, power_weights  # noqa: E402
from manylights.rendering import Merged, Mixed, Progress, RenderResult, merge, mix, render  # noqa: E402

__version__ = "0.1.0"
__all__ = [
    "REQUIRED_MITSUBA",
    "Merged",
    "Mixed",
    "Progress",
    "RenderResult",
    "__version__",
    "merge",
    "merge_emitters",
    "mix",
    "plugin_dir",
    "power_sampling",
    "power_weights",
    "render",
    "scenes",
]


def __getattr__(name: str):
    # Not imported with the package, since it needs usd-core
    if name == "usd":
        return importlib.import_module("manylights.usd")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

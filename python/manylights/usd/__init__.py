"""USD stages as dictionaries for ``mi.load_dict``::

    scene = mi.load_dict(manylights.usd.load("scene.usdc"))

Needs ``pip install 'manylights[usd]'``.
"""

from __future__ import annotations

try:
    import pxr  # noqa: F401
except ImportError as error:
    raise ImportError(
        "manylights.usd needs usd-core, which is not installed: pip install 'manylights[usd]'"
    ) from error

from manylights.usd.convert import write_xml
from manylights.usd.reader import SceneDict, describe, load
from manylights.usd.stage import StageError

__all__ = ["SceneDict", "StageError", "describe", "load", "write_xml"]

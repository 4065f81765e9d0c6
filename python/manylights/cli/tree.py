"""The command ``manylights tree``."""

from __future__ import annotations

import json

from manylights import lights, loading
from manylights.cli import options as shared
from manylights.progress import waiting


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "tree", parents=[common], help="describe the lights of a scene and their tree"
    )
    shared.add_scene(parser)
    shared.add_usd(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--variant", default="scalar_rgb", help="(default: scalar_rgb)")
    parser.set_defaults(command=_run)


def _run(options) -> None:
    loading.set_variant(options.variant)
    defines, stage = shared.defines(options), shared.usd_options(options)
    with waiting("loading"):
        found = lights.describe(options.scene, defines, stage)
    print(json.dumps(found) if options.json else lights.format_report(found))

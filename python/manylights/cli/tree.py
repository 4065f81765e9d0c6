"""The command ``manylights tree``."""

from __future__ import annotations

import json

from manylights import lights, loading
from manylights.cli import options as shared
from manylights.progress import waiting

HELP = """\
Prints how many lights of which kind a scene has, each triangle of a lamp by itself, how many are in
the tree, and the nodes, depth, memory and build time of that.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "tree",
        parents=[common],
        help="describe the lights of a scene and their tree",
        description=HELP,
    )
    shared.add_scene(parser)
    shared.add_usd(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    shared.add_scalar_variant(parser)
    parser.set_defaults(command=_run)


def _run(options) -> None:
    loading.set_variant(options.variant)
    defines, stage = shared.defines(options), shared.usd_options(options)
    with waiting("loading"):
        found = lights.describe(options.scene, defines, stage)
    print(json.dumps(found) if options.json else lights.format_report(found))

"""The command ``manylights convert``."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from manylights import files, loading
from manylights.cli import options as shared
from manylights.errors import UsageError
from manylights.loading.parsing import USD_ENDINGS, import_usd
from manylights.progress import say, waiting

HELP = """\
Writes a USD stage as XML, with its meshes and pictures as files in a folder of the same
name beside it. The plain mitsuba command renders it:

  mitsuba -a "$(manylights plugin-dir)" OUT.xml
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "convert",
        parents=[common],
        help="write a USD stage as XML",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("stage", metavar="STAGE", help="USD stage")
    parser.add_argument("output", metavar="OUT.xml", help="file to write")
    shared.add_usd(parser)
    shared.add_scalar_variant(parser)
    parser.set_defaults(command=_run)


def _run(options) -> None:
    if not options.stage.lower().endswith(USD_ENDINGS):
        raise UsageError(f"{options.stage}: not a USD stage ({', '.join(USD_ENDINGS)})")
    target = files.check_output(
        options.output, "Mitsuba's scenes are XML files", ".xml", named=False
    )
    usd = import_usd(options.stage)
    loading.set_variant(options.variant)
    with waiting("loading"):
        description = usd.describe(options.stage, **asdict(shared.usd_options(options)))
    for note in description.notes:
        say(note.text)
    if description.exposure != 1.0:
        say(f"camera: multiply images by its exposure, {description.exposure:g}: XML has none")
    with waiting("writing"):
        written = usd.write_xml(description, target)
    say(f"wrote {target} and {len(written) - 1} files in {target.with_suffix('')}")

"""The command ``manylights report``."""

from __future__ import annotations

import sys

from manylights.errors import UsageError

HELP = """\
Reads what "manylights bench" wrote to DIR and makes one HTML page of it that needs no other
file, and DIR/README.md with the most important tables. The page's charts are also written to
DIR/charts as PNG and SVG: overview, error_time_SCENE, reach_ERROR, lights_FAMILY,
sweep_PARAMETER_SCENE, boundary_SCENE and pictures_SCENE.
"""

#: Packages that only this command and the measuring need.
EXTRA_PACKAGES = ("jinja2", "matplotlib", "scipy")


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "report",
        parents=[common],
        help="make a web page and charts of measurements",
        description=HELP,
    )
    parser.add_argument("folder", metavar="DIR", help="what bench wrote")
    parser.add_argument(
        "-o", "--output", metavar="PAGE.html", help="page to write (default: DIR/report.html)"
    )
    parser.add_argument(
        "--publish",
        action="store_true",
        help="leave out pictures and file names of private scenes, keep their numbers",
    )
    parser.set_defaults(command=_run)


def _run(options) -> None:
    write_report = _import_writer()
    written, remarks = write_report(options.folder, options.output, options.publish)
    for remark in remarks:
        print(remark, file=sys.stderr)
    print(f"wrote {written}", file=sys.stderr)


def _import_writer():
    """Return ``page.write_report``, or raise UsageError that says what to install."""
    try:
        from manylights.report.page import write_report
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in EXTRA_PACKAGES:
            raise
        raise UsageError(
            f"report needs {error.name}, install it with: pip install 'manylights[bench]'"
        ) from error
    return write_report

"""The command ``manylights info``."""

from __future__ import annotations

from manylights.errors import UsageError
from manylights.output import channels, exr
from manylights.rendering import metadata

HELP = """\
Prints what an OpenEXR file of manylights says about itself: its size and channels, the scene, the
samples, the noise that was reached, the integrator with all parameters, versions and the camera.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "info", parents=[common], help="tell how an image was made", description=HELP
    )
    parser.add_argument("image", metavar="FILE.exr", help="an image that manylights wrote")
    parser.set_defaults(command=_run)


def _run(options) -> None:
    names, (width, height), attributes = exr.read_header(options.image)
    if not any(name.startswith(exr.OURS) for name in attributes):
        raise UsageError(f"{options.image}: no render of manylights, it has no {exr.OURS}* in it")
    print(f"{options.image}: {width} x {height}")
    shown = [name for name in names if not channels.is_sum(name)]
    sums = " and their sums" if len(shown) < len(names) else ""
    print(f"{'channels:':<{metadata.INDENT}}{', '.join(shown)}{sums}")
    print("\n".join(metadata.describe(attributes)))

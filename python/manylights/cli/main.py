"""Puts the commands together, and turns errors into one line and an exit status."""

from __future__ import annotations

import argparse
import os
import re
import sys

import shtab

from manylights.cli import (
    bench,
    compare,
    convert,
    demo,
    info,
    merge,
    mix,
    render,
    report,
    tree,
    version,
)
from manylights.errors import in_shell, one_line
from manylights.progress import INTERRUPTED

#: Exit status of a command that could not do what was asked.
FAILURE = 2

HELP = """\
examples:
  manylights demo                                     a city with 20,000 lights
  manylights render scene.xml -o image.exr --spp 64   your scene, of Mitsuba or USD
  manylights tree scene.xml                           which lights it has

Renders scenes with very many lights. `manylights COMMAND --help` has more.
"""

#: In the order of the help; each has ``add(commands, common)``.
COMMANDS = (render, merge, mix, info, tree, convert, demo, bench, compare, report)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all others are."""

    def error(self, message: str):
        """End the process with what is wrong, and where to read what is right."""
        text = re.sub(r"^argument (\S+): ", r"\1 ", message)
        self.exit(FAILURE, f"{self.prog}: {text} (see {self.prog} --help)\n")

    def parse_known_args(self, args=None, namespace=None):
        """Parse; what a command does not know is its own error and not that of all."""
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unknown: {' '.join(unknown)}")
        return options, unknown


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status: 0, 2 for errors, 130 after Ctrl-C.

    ``compare`` returns 1, too, for images that differ.

    Args:
        arguments: what follows the command's name. Default: what the process was started with.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    made = parser()
    options = made.parse_args(arguments)
    options.arguments = arguments
    if options.version:
        print(version.describe(options.verbose))
        return 0
    if options.command is None:
        made.error("which COMMAND?")
    try:
        with in_shell():
            return options.command(options) or 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if options.debug:
            raise
        text = one_line(error).removeprefix("manylights: ")
        print(f"manylights: {text}", file=sys.stderr)
        return FAILURE


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands; what it parses has the function ``command``."""
    common = Parser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    made = Parser(
        prog="manylights",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--version", action="store_true", help="print the version")
    made.add_argument(
        "--verbose", action="store_true", help="with --version: versions, variants, LLVM, CPU, GPU"
    )
    shtab.add_argument_to(
        made, "--print-completion", help="print what lets a shell complete commands and options"
    )
    made.set_defaults(command=None)
    commands = made.add_subparsers(metavar="COMMAND")
    folder = commands.add_parser(
        "plugin-dir", parents=[common], help='print the folder for: mitsuba -a "$(...)" scene.xml'
    )
    folder.set_defaults(command=_plugin_dir)
    for command in COMMANDS:
        command.add(commands, common)
    return made


def _plugin_dir(options) -> None:
    import manylights

    print(manylights.plugin_dir())

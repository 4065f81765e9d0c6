"""The command ``manylights``, a file for each of its commands.

``main`` puts them together, ``options`` has what several of them share.
"""

from manylights.cli.main import main

__all__ = ["main"]

"""Lets ``python -m manylights`` do what the command ``manylights`` does."""

import sys

from manylights.cli import main

if __name__ == "__main__":
    sys.exit(main())

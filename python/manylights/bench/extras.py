"""Packages that only measuring and reporting need, the extra ``bench`` of the package."""

from __future__ import annotations

import importlib

from manylights.errors import UsageError


def require(module: str, package: str):
    """Import a module of the extra ``bench`` and return it.

    Args:
        module: its name for ``import``.
        package: the name of its distribution, for the message.

    Raises:
        UsageError: it is not installed; the text names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(
            f"the package {package} is missing ({error}), install it with: "
            "pip install 'manylights[bench]'"
        ) from error

"""What ``manylights --version`` prints, and what reports of faults need to say."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import shutil
import subprocess

import drjit as dr
import mitsuba as mi

import manylights
from manylights.loading import has_backend
from manylights.threads import processor

#: Packages whose version may matter; those that are not installed are named, too.
PACKAGES = ("numpy", "usd-core", "OpenEXR", "mitsuba-oidn", "distributed")


def describe(verbose: bool) -> str:
    """Return the version, and if asked for what this machine has, a line for each."""
    if not verbose:
        return manylights.__version__
    lines = {
        "manylights": manylights.__version__,
        "Mitsuba": f"{mi.__version__}, Dr.Jit {dr.__version__}",  # pyright: ignore[reportAttributeAccessIssue]
        "Python": f"{platform.python_version()}, {platform.platform()}",
        "packages": ", ".join(map(_package, PACKAGES)),
        "plugins": manylights.plugin_dir(),
        "variants": ", ".join(compiled_variants()),
        "LLVM": _llvm(),
        "CPU": f"{processor()}, {dr.thread_count()} threads",
        "GPU": _gpu(),
    }
    return "\n".join(f"{name + ':':<12}{text}" for name, text in lines.items())


def compiled_variants() -> list[str]:
    """Return Mitsuba's variants that the plugins were compiled for; changes the current one."""
    found = []
    for name in mi.variants():
        try:
            mi.set_variant(name)
            mi.load_dict({"type": "manylights_direct"})
        except Exception as error:
            # What a plugin says in a variant that it was not compiled for
            listed = re.search(r"compiled for the variants (\S+) and not for", str(error))
            if listed:
                return listed.group(1).split(",")
        found.append(name)
    return found


def _package(name: str) -> str:
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"no {name}"


def _llvm() -> str:
    if not dr.has_backend(dr.JitBackend.LLVM):
        return "none found"
    version = ".".join(map(str, dr.detail.llvm_version()))
    return version if has_backend(dr.JitBackend.LLVM) else f"{version}, too old to be used"


def _gpu() -> str:
    if not dr.has_backend(dr.JitBackend.CUDA):
        return "none that can be used"
    if not shutil.which("nvidia-smi"):
        return "a GPU whose name is not known"
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    found = subprocess.run(query, capture_output=True, text=True, check=False, timeout=30)
    return "; ".join(found.stdout.strip().splitlines()) or "a GPU whose name is not known"

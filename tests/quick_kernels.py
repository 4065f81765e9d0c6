"""Kernels of LLVM variants without LLVM's optimizations: they compile in a third of the time.

A quick test renders a few small images with each kernel, so that more time would go into making it
fast than is saved. Images have the same bits (`test_determinism.py`). Processes that tests start
inherit the choice. The kernels are kept in a folder of their own, where nothing else finds them.

Slow tests, where `MANYLIGHTS_TEST_OPTIMIZED` is set, and machines without a compiler optimize.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name("quick_llvm.cpp")
FOLDER = Path(__file__).parents[1] / ".cache" / "quick-kernels"
CHOSEN = "DRJIT_LIBLLVM_PATH"
"""The environment variable that tells Dr.Jit which libLLVM to load."""

FIND_LLVM = """
import drjit as dr
if dr.has_backend(dr.JitBackend.LLVM):
    paths = [line.split(maxsplit=5)[-1].strip() for line in open("/proc/self/maps")]
    print(next(path for path in paths if "libLLVM" in path))
"""


def use():
    """Let this process and its children compile quickly; call it before Dr.Jit compiles."""
    if CHOSEN in os.environ or os.environ.get("MANYLIGHTS_TEST_OPTIMIZED"):
        return
    llvm = find_llvm()
    library = llvm and build(llvm)
    if library:
        kernels = FOLDER / "kernels"
        kernels.mkdir(exist_ok=True)
        os.environ |= {CHOSEN: str(library), "DRJIT_CACHE_DIR": str(kernels)}


def optimized_environment(kernels):
    """Variables of a process that optimizes its kernels and keeps them in the folder `kernels`."""
    environment = {key: value for key, value in os.environ.items() if key != CHOSEN}
    return environment | {"DRJIT_CACHE_DIR": str(kernels)}


def find_llvm():
    """Path of the libLLVM that Dr.Jit loads, '' if there is none or it is no Linux."""
    if not sys.platform.startswith("linux"):
        return ""
    command = [sys.executable, "-c", FIND_LLVM]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def build(llvm):
    """The library in front of the one at the path `llvm`, or `None` without a compiler."""
    digest = hashlib.sha256(SOURCE.read_bytes() + llvm.encode()).hexdigest()[:16]
    library = FOLDER / f"libquick-{digest}.so"
    if library.exists():
        return library
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FOLDER) as folder:
        made = Path(folder) / library.name
        command = [os.environ.get("CXX", "c++"), "-shared", "-fPIC", "-O1", "-o", made, SOURCE]
        command += ["-Wl,--no-as-needed", llvm, f"-Wl,-rpath,{Path(llvm).parent}"]
        try:
            subprocess.run(command, capture_output=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        return made.replace(library)

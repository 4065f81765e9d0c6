"""Fixtures shared by all tests: variants, the plugin, threads and the folder for failures."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from tests import quick_kernels

# Dr.Jit loads libLLVM when it is imported.
quick_kernels.use()

# ruff: noqa: E402
import drjit as dr
import mitsuba as mi
import pytest
from manylights.loading import has_backend

from tests import shared_results, statistics_tools

# Processes of tests share the cores. Mitsuba does not read images with a single thread.
if statistics_tools.THREADS is not None:
    dr.set_thread_count(max(2, statistics_tools.THREADS))

VARIANTS = ("scalar_rgb", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_mono_polarized")
"""Variants that the tests run in by default."""

BACKEND = os.environ.get("MANYLIGHTS_TEST_BACKEND", "llvm")
"""What runs the tests of LLVM variants: `llvm`, or `cuda` for the CUDA variants instead."""

NO_INFINITY = "OptiX finds no surface at all in a scene with a vertex at infinity"
"""Why a test is skipped in CUDA variants."""


def pytest_configure(config):
    """Before the processes of a parallel run start, which have a `workerinput`."""
    if not hasattr(config, "workerinput"):
        shared_results.begin()
        # Threads of FLIP and of numpy keep cores busy while they wait, too
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            os.environ.setdefault(name, "1")


def pytest_collection_modifyitems(items):
    """Bring the tests of a file in the order of their variants.

    With each change to a JIT variant Mitsuba loads its integrators in Python again, which takes
    as long as a short test. Scalar tests come last: their references are those of LLVM variants.
    """
    files = {item.path: place for place, item in enumerate(items)}
    items.sort(key=lambda item: (files[item.path], last_if_scalar(variant_of(item))))


def variant_of(item):
    """The variant that a test runs in, '' if it is not known before."""
    if hasattr(item, "callspec") and "variant" in item.callspec.params:
        return str(item.callspec.params["variant"])
    fixtures = {"llvm": "llvm_ad_rgb", "scalar": "scalar_rgb"}
    return next((fixtures[name] for name in item.fixturenames if name in fixtures), "")


def last_if_scalar(variant):
    """A key to sort variants by."""
    return variant == "" or variant.startswith("scalar"), variant


def pytest_unconfigure(config):
    """After they have ended."""
    if not hasattr(config, "workerinput"):
        shared_results.end()


def require_variant(name):
    """Skip the test if this machine cannot run the variant, else make it the current one.

    Returns its name: another one than `name` if `BACKEND` is `cuda`.
    """
    name = name.replace("llvm", BACKEND)
    if name not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {name}")
    if name.startswith("llvm") and not has_backend(dr.JitBackend.LLVM):
        pytest.skip(f"{name} needs LLVM 17 or later (on Debian: apt install libllvm19)")
    if name.startswith("cuda") and not has_backend(dr.JitBackend.CUDA):
        pytest.skip(f"{name} needs an NVIDIA driver and GPU")
    mi.set_variant(name)
    return name


def heed_ctrl_c():
    """In a new process (`preexec_fn`): SIGINT ends it, though the tests run in the background.

    Shells start what ends in `&` with that signal ignored, and children inherit it.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture(params=VARIANTS)
def variant(request):
    """Each default variant in turn, set as the current one.

    Other variants: `@pytest.mark.parametrize("variant", [...], indirect=True)`.
    """
    return require_variant(request.param)


@pytest.fixture
def llvm():
    """The variant llvm_ad_rgb, or what `BACKEND` makes of it, or a skip."""
    return require_variant("llvm_ad_rgb")


@pytest.fixture
def scalar():
    """The variant scalar_rgb."""
    return require_variant("scalar_rgb")


@pytest.fixture
def own_threads():
    """Render with this process's share of the cores: threads without work keep a core busy.

    For tests that read and write no OpenEXR files, which Mitsuba never ends with a single thread.
    """
    with statistics_tools.thread_count(statistics_tools.THREADS):
        yield


@pytest.fixture(scope="session")
def plugin():
    """The package manylights; importing it makes its plugins known to Mitsuba."""
    import manylights

    return manylights


@pytest.fixture
def thread_count(monkeypatch):
    """A function that sets the number of rendering threads; undone after the test."""
    monkeypatch.setattr(statistics_tools, "THREADS", None)
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


@pytest.fixture(scope="session")
def failure_folder():
    """Folder for images of failed comparisons: $MANYLIGHTS_TEST_OUTPUT, or in .cache."""
    default = Path(__file__).parents[1] / ".cache" / "failed-tests"
    return Path(os.environ.get("MANYLIGHTS_TEST_OUTPUT", default))

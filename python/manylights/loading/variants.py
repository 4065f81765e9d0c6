"""Which variants of Mitsuba this machine can run."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from manylights.errors import UsageError, argument

#: Kernels of Dr.Jit 1.5 abort the process with an older LLVM on x86-64.
OLDEST_LLVM = 17


def has_backend(backend: dr.JitBackend) -> bool:
    """Can kernels be compiled for this backend on this machine?"""
    if not dr.has_backend(backend):
        return False
    return backend != dr.JitBackend.LLVM or int(dr.detail.llvm_version()[0]) >= OLDEST_LLVM


def default_variant() -> str:
    """Return ``llvm_ad_rgb`` where a usable libLLVM is installed, else ``scalar_rgb``."""
    has_llvm = "llvm_ad_rgb" in mi.variants() and has_backend(dr.JitBackend.LLVM)
    return "llvm_ad_rgb" if has_llvm else "scalar_rgb"


def set_variant(name: str | None) -> str:
    """Set Mitsuba's variant, ``None`` for the default one, and return its name.

    Raises:
        UsageError: Mitsuba does not have it, or the machine lacks LLVM or CUDA.
    """
    variant, name = name or default_variant(), argument("variant")
    if variant not in mi.variants():
        raise UsageError(f"{name} {variant}: unknown, choose from {', '.join(mi.variants())}")
    needs = (
        ("llvm", dr.JitBackend.LLVM, f"LLVM {OLDEST_LLVM} or later (on Debian: libllvm19)"),
        ("cuda", dr.JitBackend.CUDA, "an NVIDIA driver and GPU"),
    )
    for prefix, backend, what in needs:
        if variant.startswith(prefix) and not has_backend(backend):
            raise UsageError(f"{name} {variant}: needs {what}; a scalar variant does without")
    mi.set_variant(variant)
    return variant

"""Choice of the Mitsuba backend, and its initialisation once per process."""

from __future__ import annotations

import os

from steadylight.errors import BackendError
from steadylight.llvm import find_llvm

VARIANTS = {"llvm": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}


def resolve_variant(choice: str) -> str:
    """Turn `auto`, `llvm` or `cuda` into the Mitsuba variant that works on this machine.

    Raises:
        BackendError: the chosen backend (or, for auto, every backend) is unusable; says what to install.
    """
    find_llvm()
    import drjit as dr

    cuda = dr.has_backend(dr.JitBackend.CUDA)
    # Older versions of LLVM load, but abort the process during code generation.
    llvm = dr.has_backend(dr.JitBackend.LLVM) and dr.detail.llvm_version() >= (16,)
    if choice == "cuda" and not cuda:
        raise BackendError(
            "--variant cuda: no CUDA device was found; install NVIDIA's driver, or use --variant llvm"
        )
    if choice == "llvm" and not llvm:
        raise BackendError(_NO_LLVM)
    if choice == "auto" and not (cuda or llvm):
        raise BackendError(f"no CUDA device was found, and {_NO_LLVM}")
    return VARIANTS[choice] if choice != "auto" else VARIANTS["cuda" if cuda else "llvm"]


_NO_LLVM = (
    "no usable LLVM library was found: install LLVM 16 or newer "
    "(Linux: `pip install karellen-llvm-core`; macOS: `brew install llvm`; Windows: the LLVM installer) "
    "or set DRJIT_LIBLLVM_PATH to its libLLVM"
)


def use_variant(variant: str, *, threads: int | None = None) -> None:
    """Make `variant` the backend of this process and register our plugins.

    Args:
        variant: `llvm_ad_rgb` or `cuda_ad_rgb`.
        threads: of the LLVM backend; all cores if None.

    Raises:
        BackendError: this backend is unusable here. If Mitsuba was imported before, Dr.Jit may have loaded an old
            system LLVM: call this first.
    """
    choice = next(name for name, value in VARIANTS.items() if value == variant)
    resolve_variant(choice)
    import drjit as dr
    import mitsuba as mi

    if mi.variant() != variant:
        mi.set_variant(variant)
    dr.set_thread_count(threads or os.cpu_count() or 1)
    mi.set_log_level(mi.LogLevel.Error)
    from steadylight.renderers.mitsuba import irradiance_cache
    from steadylight.renderers.mitsuba.bsdf import glass

    irradiance_cache.register()
    glass.register()

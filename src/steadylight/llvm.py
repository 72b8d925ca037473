"""The libLLVM that came as a wheel, made known to Dr.Jit before Mitsuba is imported anywhere."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from pathlib import Path

_VARIABLE = "DRJIT_LIBLLVM_PATH"


def find_llvm() -> None:
    """Point Dr.Jit at the libLLVM that came as a wheel, unless the user chose another.

    Dr.Jit takes the first libLLVM that it finds when Mitsuba is imported, and keeps it: on many systems that
    is one too old to be used. So whoever imports Mitsuba first calls this before.
    """
    if _VARIABLE in os.environ or not sys.platform.startswith("linux"):
        return
    try:
        files = importlib.metadata.files("karellen-llvm-core") or []
    except importlib.metadata.PackageNotFoundError:
        return
    paths = (Path(str(file.locate())) for file in files if file.name == "libLLVM.so")
    found = next((path for path in paths if path.exists()), None)
    if found is not None:
        os.environ[_VARIABLE] = str(found.resolve())

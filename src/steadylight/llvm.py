"""Points Dr.Jit at the libLLVM installed as a wheel, before Mitsuba is imported anywhere."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from pathlib import Path

_VARIABLE = "DRJIT_LIBLLVM_PATH"


def find_llvm() -> None:
    """Point Dr.Jit at the libLLVM installed as a wheel, unless the user chose another.

    Dr.Jit loads the first libLLVM that it finds when Mitsuba is imported and keeps it. On many systems that one is too
    old. Call this before the first import of Mitsuba.
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

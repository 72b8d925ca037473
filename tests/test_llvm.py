"""The libLLVM of the wheel is found, whatever imports Mitsuba first."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys

import pytest

from small_film import write_film

PROGRAM = """
from steadylight.scenes import load_scene
load_scene("room.xml")
from steadylight.renderers.mitsuba.backend import resolve_variant
print(resolve_variant("llvm"))
"""


def test_a_scene_file_may_be_read_before_the_backend_is_chosen(tmp_path):
    """Reading it imports Mitsuba, and with it the libLLVM of the system, which may be too old to be used."""
    try:
        importlib.metadata.version("karellen-llvm-core")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("the wheel with libLLVM is not installed")
    write_film(tmp_path)
    environment = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
    given = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(
        given, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.stdout == "llvm_ad_rgb\n", done.stderr

"""A run that a farm's own program performs has the bytes of a render."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from steadylight.animation.farm import FINISH


@pytest.mark.slow
def test_openjd_run_renders_twelve_frames_of_the_gallery_with_the_bytes_of_a_render(tmp_path):
    options = ("gallery", "--frames", "12", "--size", "32x24", "--spp", "1", "--quality", "draft")
    program = shutil.which("steadylight", path=str(Path(sys.executable).parent))
    openjd = shutil.which("openjd", path=str(Path(sys.executable).parent))
    assert program
    assert openjd

    def call(*words):
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=1800)
        assert done.returncode == 0, done.stdout + done.stderr

    call(program, "render", *options, "--output", "a farm's run", "--prepare-only")
    call(
        program, "export", "a farm's run", "--format", "openjd", "--program", program, "--output", "job.json"
    )
    call(openjd, "run", "job.json", "--step", FINISH, "--run-dependencies")
    call(program, "render", *options, "--output", "local")
    farmed, local = (
        {
            path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for folder in ("frames", "cache")
            for path in (root / folder).iterdir()
        }
        for root in (tmp_path / "a farm's run", tmp_path / "local")
    )
    assert len([name for name in local if name.startswith("frames/")]) == 12
    assert farmed == local
    assert (tmp_path / "a farm's run" / "report.html").exists()

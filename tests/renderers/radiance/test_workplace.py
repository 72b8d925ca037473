"""Temporary folders go with their processes."""

from __future__ import annotations

import subprocess
import sys
import tempfile

import pytest

from steadylight.renderers.radiance.workplace import Workplace

KILLED = """
import os, signal
from steadylight.renderers.radiance.workplace import Workplace
place = Workplace()
print(place.folder, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)


def test_a_folder_goes_with_its_object():
    place = Workplace()
    folder = place.folder
    assert folder.is_dir()
    del place
    assert not folder.exists()


def test_the_folder_of_a_killed_process_goes_when_the_next_is_made_and_that_of_a_living_one_stays(tmp_path):
    living = Workplace()
    subprocess.run([sys.executable, "-c", KILLED], check=False, capture_output=True)
    assert len(list(tmp_path.iterdir())) == 2
    another = Workplace()
    assert sorted(tmp_path.iterdir()) == sorted([living.folder, another.folder])

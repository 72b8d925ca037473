"""A temporary folder that is removed with its process, or at the latest when another process needs such a folder."""

from __future__ import annotations

import fcntl
import os
import shutil
import weakref
from contextlib import suppress
from pathlib import Path
from tempfile import gettempdir, mkdtemp
from typing import Final

_PREFIX: Final = "steadylight-radiance-"
_LOCK: Final = "lock"


class Workplace:
    """A temporary folder of this process.

    A worker that is killed removes nothing. Each folder therefore has a file that its process keeps locked, and whoever
    creates a folder removes those that are no longer locked.

    Attributes:
        folder: its path.
    """

    def __init__(self) -> None:
        """Create the folder, and remove those of processes that no longer exist."""
        for other in Path(gettempdir()).glob(f"{_PREFIX}*"):
            _remove_if_left(other)
        self.folder = Path(mkdtemp(prefix=_PREFIX))
        unlocked = self.folder / "unlocked"
        lock = os.open(unlocked, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)
        fcntl.flock(lock, fcntl.LOCK_EX)
        unlocked.rename(self.folder / _LOCK)  # the lock file is never visible unlocked
        weakref.finalize(self, _remove, self.folder, lock)


def _remove(folder: Path, lock: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)


def _remove_if_left(folder: Path) -> None:
    """Remove a folder whose lock is not held; one without a lock file is just being created."""
    with suppress(OSError):
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)

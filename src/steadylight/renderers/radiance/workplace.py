"""A temporary folder that goes when its process does, at the latest when the next one needs such a folder."""

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
    """A folder of this process.

    A worker may be killed, and then removes nothing. So each folder has a file that its process keeps locked, and
    whoever makes a folder removes those that nobody has locked.

    Attributes:
        folder: its path.
    """

    def __init__(self) -> None:
        """Make the folder, and remove those of processes that are gone."""
        for other in Path(gettempdir()).glob(f"{_PREFIX}*"):
            _remove_if_left(other)
        self.folder = Path(mkdtemp(prefix=_PREFIX))
        unlocked = self.folder / "unlocked"
        lock = os.open(unlocked, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)
        fcntl.flock(lock, fcntl.LOCK_EX)
        unlocked.rename(self.folder / _LOCK)  # nobody sees it before it is locked
        weakref.finalize(self, _remove, self.folder, lock)


def _remove(folder: Path, lock: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)


def _remove_if_left(folder: Path) -> None:
    """Remove a folder whose lock nobody holds; one without a lock is being made at this moment."""
    with suppress(OSError):
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)

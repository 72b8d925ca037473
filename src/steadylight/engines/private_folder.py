"""Folders for certificates and scratch files: no other user can enter them, and killed commands leave none behind.

A fixed name in the temporary folder is not safe on a shared machine: another user may create it first, with links that
point at files of the victim. Hence every folder has a random name and belongs to one process, which holds a lock in it.
"""

from __future__ import annotations

import fcntl
import glob
import os
import shutil
import socket
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from steadylight.errors import StorageError

PREFIX: Final = "steadylight-scratch-"
_LOCK: Final = "lock"


class PrivateFolder:
    """A new folder, readable by this user only; removed by `remove`, or by a later command if this process is killed.

    Attributes:
        path: path of the folder.
    """

    def __init__(self, parent: Path | None = None) -> None:
        """Make the folder, and remove those of killed processes next to it.

        Args:
            parent: where to make it; the system's temporary folder if None.

        Raises:
            StorageError: nothing can be written there.
        """
        try:
            parent = Path(tempfile.gettempdir()) if parent is None else parent
            _remove_abandoned(parent)
            self.path = Path(tempfile.mkdtemp(prefix=_prefix(), dir=parent))
        except OSError as error:
            raise StorageError(
                f"no private folder can be made in {parent or 'any temporary folder'}: "
                f"{(error.strerror or str(error)).lower()}; set TMPDIR to a folder that you can write to"
            ) from error
        fresh = self.path / f"{_LOCK}.new"
        self._lock = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with suppress(OSError):  # a file system without locks: the folder is not removed if we are killed
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # From now on, others take the folder for abandoned if this file is not locked.
        fresh.rename(self.path / _LOCK)

    def remove(self) -> None:
        """Remove the folder and everything in it; harmless if it is gone."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def _prefix() -> str:
    """Name prefix of this machine's folders: machines may share the parent folder but not see each other's locks."""
    return f"{PREFIX}{socket.gethostname()}-"


def _remove_abandoned(parent: Path) -> None:
    """Remove private folders of this user whose process has ended."""
    for folder in parent.glob(f"{glob.escape(_prefix())}*"):
        with suppress(OSError):
            about = folder.lstat()
            if stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and _is_abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)


def _is_abandoned(folder: Path) -> bool:
    """Whether nobody holds the lock of a folder."""
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(lock)
    return True

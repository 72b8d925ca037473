"""The lock of a run directory: it ends with the process that holds it."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import socket
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from steadylight.atomic_file import storage_errors
from steadylight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from pathlib import Path

_log = logging.getLogger(__name__)

_TRIES: Final = 5


class Lock:
    """A file that one command holds alone, or several commands share.

    Args:
        path: path of the file, in a folder of the run directory.
        root: the run directory, for messages.
    """

    def __init__(self, path: Path, root: Path) -> None:
        self._path, self._root = path, root
        self._held: int | None = None
        self.shared = False

    @property
    def held(self) -> bool:
        """Whether this command holds it."""
        return self._held is not None

    def take(self, *, shared: bool = False) -> None:
        """Take the lock; harmless if it is held already.

        Raises:
            SettingsError: another command holds it.
            StorageError: the file cannot be written, or is replaced again and again.
        """
        if self._held is not None:
            return
        for _ in range(_TRIES):
            lock = self._opened(shared=shared)
            # A command that undoes its failed start removes the file, and a lock on a removed file excludes nobody.
            if self._is_there(lock):
                break
            os.close(lock)
        else:
            raise self._replaced()
        self._held, self.shared = lock, shared
        # The content only names the holder in error messages; it may be missing on a full disk.
        with suppress(OSError):
            os.ftruncate(lock, 0)
            os.pwrite(lock, f"host {socket.gethostname()}, process {os.getpid()}\n".encode(), 0)

    def check(self) -> None:
        """Check that this command still has the directory for itself; harmless if the lock is not held.

        Raises:
            StorageError: the lock file was removed or replaced, so that another command may be working here.
        """
        if self._held is not None and not self._is_there(self._held):
            raise self._replaced()

    def remove(self) -> None:
        """Remove the file of a lock that is held, to undo a failed start."""
        if self._held is not None:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def release(self) -> None:
        """Give the lock back; harmless if it is not held."""
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _opened(self, *, shared: bool) -> int:
        with storage_errors(self._path):
            # Not through a link: a run directory from elsewhere may have one in place of any file.
            lock = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in {errno.EWOULDBLOCK, errno.EACCES}:
                holder = os.read(lock, 1000).decode(errors="replace").strip() or "an unnamed process"
                os.close(lock)
                raise SettingsError(
                    f"{self._root}: another steadylight command is using this run directory ({holder}); "
                    "wait for it, stop it, or choose another output"
                ) from None
            # Some cluster file systems do not support locks; refusing to run there would help nobody.
            _log.warning(
                "%s: the file system does not support locks (%s); run only one command at a time",
                self._root,
                error,
            )
        return lock

    def _is_there(self, lock: int) -> bool:
        """Whether an open file is still the one at the path of the lock."""
        held = os.fstat(lock)
        with suppress(OSError):
            there = self._path.lstat()
            return (there.st_dev, there.st_ino) == (held.st_dev, held.st_ino)
        return False

    def _replaced(self) -> StorageError:
        return StorageError(
            f"{self._path}: was removed or replaced while this command was working, so that another one may "
            "work here at the same time; leave the file alone, and run the same command again when no other is working"
        )

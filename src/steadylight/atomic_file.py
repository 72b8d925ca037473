"""Files that exist only when they are complete: written under a temporary name, read back, renamed.

File system errors on writing become StorageError here, in one place, with a remedy.
"""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from steadylight.errors import StorageError

# The suffix stays at the end because image and array libraries choose the format from it.
TEMPORARY = re.compile(r"\.partial-\d+-[0-9a-f]{12}-.+")

_REMEDIES = {
    errno.ENOSPC: "no space left on device: make room and run the same command again",
    errno.EDQUOT: "the disk quota is used up: make room and run the same command again",
    errno.EACCES: "permission denied: make the folder writable, or choose another output",
    errno.EPERM: "operation not permitted: make the folder writable, or choose another output",
    errno.EROFS: "the file system is read-only: choose an output on a writable one",
    errno.EIO: "input/output error on the device: check the disk, then run the same command again",
    errno.ESTALE: "the network file system lost the folder: check the mount, then run the same command again",
    errno.EISDIR: "a folder has this name: move it away and run the same command again",
    errno.ELOOP: "it is a symbolic link: remove it and run the same command again",
    errno.EEXIST: "a file is in the place of a folder: move it away and run the same command again",
    errno.ENAMETOOLONG: "the name is too long for the file system: choose a shorter output",
}

Validator = Callable[[Path], object]
"""Reads a file and raises an error with the reason if it is not valid."""


@contextmanager
def atomic_write(path: Path, validate: Validator | None = None, *, once: bool = False) -> Iterator[Path]:
    """Yield a temporary path to write to; on exit, flush the file, validate it and rename it to `path`.

    Each attempt has its own temporary file in the same folder (process id and random digits), so attempts never
    collide, and the rename is atomic. After any error the temporary file is removed and `path` is unchanged.

    Args:
        path: the final name; an existing file is replaced.
        validate: reads the temporary file back and raises if it is not valid.
        once: keep an existing file if it is valid and discard the new one, so that the first attempt to finish
            wins.

    Raises:
        StorageError: the folder cannot be written, or the written file cannot be read back.
    """
    temporary = path.with_name(f".partial-{os.getpid()}-{secrets.token_hex(6)}-{path.name}")
    try:
        with storage_errors(path, temporary):
            yield temporary
            _make_durable(temporary)
            if validate is not None:
                _read_back(temporary, path, validate)
            if not (once and _is_there(temporary, path, validate)):
                temporary.replace(path)
            _make_durable(path.parent)
    except Exception as error:
        # Image libraries report a full disk with their own errors, or only when the file is read back.
        if not _is_explained(error):
            with storage_errors(path):
                _probe(path)
        raise
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write plain data as JSON atomically; NaN and infinity are rejected.

    Raises:
        StorageError: the folder cannot be written.
    """
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def storage_errors(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Turn file system errors on writing into StorageError with a remedy."""
    try:
        yield
    except OSError as error:
        named = error.filename
        # The body may also read other files: errors on those do not concern the output.
        elsewhere = temporary is not None and named is not None and Path(os.fsdecode(named)) != temporary
        about_room = error.errno in {errno.ENOSPC, errno.EDQUOT}
        if error.errno in {errno.ENOENT, errno.ENOTDIR} and not path.parent.is_dir():
            raise StorageError(
                f"{path}: cannot be written: the folder {path.parent} is missing or not a folder; "
                "create it and run the same command again, or choose another output"
            ) from error
        if error.errno in _REMEDIES and (about_room or not elsewhere):
            raise StorageError(f"{path}: cannot be written: {_REMEDIES[error.errno]}") from error
        if temporary is None or (named is not None and not elsewhere):
            why = (error.strerror or str(error)).lower()
            raise StorageError(f"{path}: cannot be written: {why}; choose another output") from error
        raise


def _is_explained(error: BaseException) -> bool:
    """Whether the error already explains the storage problem."""
    cause = error.__cause__
    return isinstance(error, StorageError) and isinstance(cause, OSError) and cause.errno in _REMEDIES


def _read_back(temporary: Path, path: Path, validate: Validator) -> None:
    try:
        validate(temporary)
    except Exception as error:
        raise StorageError(
            f"{path}: the written file could not be read back ({error}); check the disk, "
            "then run the same command again"
        ) from error


def _is_there(temporary: Path, path: Path, validate: Validator | None) -> bool:
    """Link the file to its final name if that is free; return whether the name now belongs to a valid file."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:
        # A file system without hard links. A check before the rename is enough: all attempts write the same bytes.
        if not path.exists():
            return False
    else:
        return True
    try:
        if validate is not None:
            validate(path)
    except Exception:  # noqa: BLE001 - any reader error means invalid
        return False
    return True


def _make_durable(path: Path) -> None:
    """Flush a file or folder to the device, so that a rename never survives without its data."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network file systems cannot flush folders; the rename is then as durable as they allow.
        if error.errno not in {errno.EINVAL, errno.ENOTSUP, errno.EBADF} or not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def _probe(path: Path) -> None:
    """Raise OSError if 64 KiB cannot be written to the folder of `path`."""
    probe = path.with_name(f".partial-{os.getpid()}-{secrets.token_hex(6)}-probe")
    try:
        probe.write_bytes(b"\0" * 65536)
        _make_durable(probe)
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)

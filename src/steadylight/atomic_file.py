"""Files that exist only when they are complete: written under a temporary name, read back, renamed.

The errors of a disk that cannot be written become StorageError here, in one place, with what to do about it.
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

# The suffix stays at the end, because image and array libraries choose the format by it.
TEMPORARY = re.compile(r"\.partial-\d+-[0-9a-f]{12}-.+")

_REMEDIES = {
    errno.ENOSPC: "no space is left on the device: make room and run the same command again",
    errno.EDQUOT: "the disk quota is used up: make room and run the same command again",
    errno.EACCES: "permission is denied: make the folder writable for you, or choose another output",
    errno.EPERM: "the operation is not permitted: make the folder writable for you, or choose another output",
    errno.EROFS: "the file system is read-only: choose an output on a writable one",
    errno.EIO: "the device reports an input/output error: check the disk, then run the same command again",
    errno.ESTALE: "the network file system lost the folder: check the mount, then run the same command again",
    errno.ENAMETOOLONG: "the name is too long for the file system: choose a shorter output",
}

Validator = Callable[[Path], object]
"""Reads a file and raises, with a reason, if it is not what it should be."""


@contextmanager
def atomic_write(path: Path, validate: Validator | None = None, *, once: bool = False) -> Iterator[Path]:
    """Give a temporary path to write to; on leaving, the file is made durable, checked and renamed to `path`.

    Each attempt has a temporary of its own in the same folder (process id and random), so attempts never
    meet, and the rename is atomic. After any error the temporary is gone and `path` is as it was.

    Args:
        path: the final name; an existing file is replaced.
        validate: reads the temporary back and raises if it is not what it should be.
        once: an existing file is kept if it is valid, and what was written is dropped: the first attempt to
            finish is the one that counts, however many there are.

    Raises:
        StorageError: the folder cannot be written, or what was written does not read back.
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
        # Image libraries report a full disk in their own words, or not until the file is read back.
        if not _is_explained(error):
            with storage_errors(path):
                _probe(path)
        raise
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write plain data as JSON, whole or not at all; NaN and infinity are refused.

    Raises:
        StorageError: the folder cannot be written.
    """
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def storage_errors(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Turn the errors of a file system that cannot be written into StorageError with what to do."""
    try:
        yield
    except OSError as error:
        named = error.filename
        # The body of a write may also read: what it was refused elsewhere is not about the output.
        elsewhere = temporary is not None and named is not None and Path(os.fsdecode(named)) != temporary
        about_room = error.errno in {errno.ENOSPC, errno.EDQUOT}
        if error.errno in {errno.ENOENT, errno.ENOTDIR} and not path.parent.is_dir():
            raise StorageError(
                f"{path}: cannot be written: the folder {path.parent} is gone or is no folder; "
                "make it and run the same command again, or choose another output"
            ) from error
        if error.errno in _REMEDIES and (about_room or not elsewhere):
            raise StorageError(f"{path}: cannot be written: {_REMEDIES[error.errno]}") from error
        raise


def _is_explained(error: BaseException) -> bool:
    """Whether the error already says what is wrong with the disk."""
    cause = error.__cause__
    return isinstance(error, StorageError) and isinstance(cause, OSError) and cause.errno in _REMEDIES


def _read_back(temporary: Path, path: Path, validate: Validator) -> None:
    try:
        validate(temporary)
    except Exception as error:
        raise StorageError(
            f"{path}: what was written does not read back ({error}); check the disk, "
            "then run the same command again"
        ) from error


def _is_there(temporary: Path, path: Path, validate: Validator | None) -> bool:
    """Give the file its name if nobody has it yet; whether a valid file has it now."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:
        # A file system without links; a look before the rename is the next best, since attempts write the same.
        if not path.exists():
            return False
    else:
        return True
    try:
        if validate is not None:
            validate(path)
    except Exception:  # noqa: BLE001 - whatever a reader says of it, it is not valid
        return False
    return True


def _make_durable(path: Path) -> None:
    """Flush a file or folder to the device: a rename must not outlive the data it names."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network file systems cannot flush folders; the rename is then as safe as they make it.
        if error.errno not in {errno.EINVAL, errno.ENOTSUP, errno.EBADF} or not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def _probe(path: Path) -> None:
    """Raise OSError if the folder of `path` has no room for as little as 64 KiB."""
    probe = path.with_name(f".partial-{os.getpid()}-{secrets.token_hex(6)}-probe")
    try:
        probe.write_bytes(b"\0" * 65536)
        _make_durable(probe)
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)

"""Files of a run at a URL, and local copies of some of them."""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import fsspec

from steadylight.atomic_file import TEMPORARY, atomic_write, storage_errors
from steadylight.errors import SettingsError, SteadylightError, StorageError
from steadylight.redaction import redacted

RECORD: Final = "run.json"
_CREATING: Final = {"s3", "s3a", "gs", "gcs", "abfs", "az", "memory"}
_OBJECT_STORES: Final = _CREATING | {"adl", "oss"}
_PLAIN: Final = {"file", "local"}


def is_url(output: object) -> bool:
    """Whether an output is a URL rather than a path."""
    return isinstance(output, str) and "://" in output


def copy_of(url: str) -> Path:
    """Folder of this user's local copy of a run at a URL.

    Raises:
        SettingsError: other users can write there. The scene is a pickle, which can execute any code.
        StorageError: the folder cannot be made.
    """
    name = hashlib.sha256(url.rstrip("/").encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"steadylight-{os.getuid()}"
    make_folder(folder)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o022:
        raise SettingsError(
            f"{folder}: must be a folder that you own and nobody else can write to, because copies of runs are kept "
            "there; remove it, or set TMPDIR to another folder"
        )
    return folder / name


class Store:
    """The files of a run at a URL, and a copy of some of them in a folder."""

    def __init__(self, url: str, copy: Path) -> None:
        """Connect.

        Args:
            url: URL of the run directory.
            copy: a folder on this machine.

        Raises:
            SettingsError: the URL cannot be reached from this machine.
        """
        self.url = url.rstrip("/")
        self.copy = copy
        self._protocol = url.split("://", maxsplit=1)[0]
        # Object stores publish only complete files; elsewhere, write a temporary file and rename it.
        self._whole = self._protocol in _OBJECT_STORES
        try:
            self._files, self._root = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError, OSError) as error:
            raise SettingsError(
                f"--output {redacted(url)}: cannot be reached ({redacted(str(error))}); install the fsspec "
                "backend it needs, such as s3fs, or choose another output"
            ) from error

    def __str__(self) -> str:
        return redacted(self.url)

    def names(self) -> dict[str, int]:
        """Sizes of all files in the store, by name relative to the run directory, without temporary files."""
        return {name: size for name, size in self._find().items() if not _is_temporary(name)}

    def fetch(self, names: Iterable[str]) -> None:
        """Copy files from the store, each atomically.

        Raises:
            StorageError: the store cannot be read, or the local disk cannot be written.
        """
        for name in names:
            target = self.copy / name
            make_folder(target.parent)
            with atomic_write(target) as temporary, self._errors(temporary):
                self._files.get_file(f"{self._root}/{name}", str(temporary))

    def follow_run(self) -> bool:
        """Make the copy follow the run in the store: the copy of another run is deleted.

        Files are identified by name and size, which may be equal in two runs.

        Returns:
            Whether the store has a run.
        """
        there = self.read(RECORD)
        record = self.copy / RECORD
        if there is not None and record.exists() and record.read_bytes() == there:
            return True
        with storage_errors(self.copy):
            if self.copy.exists():
                shutil.rmtree(self.copy)
        if there is not None:
            make_folder(self.copy)
            with atomic_write(record) as temporary:
                temporary.write_bytes(there)
        return there is not None

    def check_same_run(self) -> None:
        """Check that the copy still belongs to the run in the store.

        Raises:
            StorageError: it does not.
        """
        if self.read(RECORD) != (self.copy / RECORD).read_bytes():
            raise StorageError(f"{self}: now belongs to another run; the result of this task was discarded")

    def store(self, names: Iterable[str]) -> None:
        """Copy files to the store, in this order, each atomically."""
        for name in names:
            with self._writing(name) as path:
                self._files.put_file(str(self.copy / name), path)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files from the store; missing ones are ignored."""
        for name in names:
            with self._errors(), suppress(FileNotFoundError):
                self._files.rm_file(f"{self._root}/{name}")

    def sweep(self) -> None:
        """Remove temporary files of interrupted writes from the store."""
        if not self._whole:
            self.remove(name for name in self._find() if _is_temporary(name))

    def read(self, name: str) -> bytes | None:
        """Content of a small file in the store; None if it does not exist."""
        with self._errors():
            self._files.invalidate_cache()
            try:
                return bytes(self._files.cat_file(f"{self._root}/{name}"))
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes) -> None:
        """Write a small file to the store atomically."""
        with self._writing(name) as path:
            self._files.pipe_file(path, content)

    def create(self, name: str, content: bytes) -> bool:
        """Write a small file to the store unless it exists.

        Returns:
            Whether check and write were one atomic step, so that nobody else can have done the same in between. Local
            files (which are empty for a moment) and the stores of Amazon, Google and Microsoft support this.
        """
        path = f"{self._root}/{name}"
        with self._errors():
            try:
                if self._protocol in _CREATING:
                    self._files.pipe_file(path, content, mode="create")
                    return True
                if self._protocol in _PLAIN:
                    self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
                    with self._files.open(path, "xb") as file:
                        file.write(content)
                    return True
            except FileExistsError:
                return True
            except Exception:  # noqa: BLE001, S110 - stores without this step raise errors of their own
                pass
            self._files.invalidate_cache()
            there = self._files.exists(path)
        if not there:
            self.write(name, content)
        return False

    def missing_folders(self, name: str) -> list[str]:
        """The folders that writing a file would create in the store, innermost first."""
        folders = []
        with self._errors():
            path = f"{self._root}/{name}".rpartition("/")[0]
            while path and not self._whole and not self._files.exists(path):
                folders.append(path)
                path = path.rpartition("/")[0]
        return folders

    def remove_folders(self, folders: Iterable[str]) -> None:
        """Remove those of `missing_folders` that are empty."""
        for folder in folders:
            with suppress(Exception):  # a leftover empty folder does no harm
                self._files.rmdir(folder)

    def _find(self) -> dict[str, int]:
        with self._errors():
            self._files.invalidate_cache()
            found = self._files.find(self._root, detail=True)
        start = len(self._root.rstrip("/")) + 1
        return {name[start:]: int(about["size"] or 0) for name, about in found.items()}

    @contextmanager
    def _writing(self, name: str) -> Iterator[str]:
        """Path to write a file to, so that it appears atomically."""
        path = f"{self._root}/{name}"
        with self._errors():
            if self._whole:
                yield path
                return
            folder, _, last = path.rpartition("/")
            self._files.makedirs(folder, exist_ok=True)
            temporary = f"{folder}/{_temporary_name(last)}"
            try:
                yield temporary
                self._files.mv(temporary, path)
            except BaseException:
                with suppress(Exception):
                    self._files.rm_file(temporary)
                raise

    @contextmanager
    def _errors(self, local: Path | None = None) -> Iterator[None]:
        """Turn library errors about the store into StorageError.

        Args:
            local: a local file that is being written; errors of its disk are passed on unchanged.
        """
        try:
            yield
        except SteadylightError:
            raise
        except Exception as error:
            if local is not None and _is_about(error, local):
                raise
            raise StorageError(
                f"{self}: cannot be read or written ({type(error).__name__}: {redacted(str(error))}); "
                "check the address and your permissions, then run the same command again"
            ) from error


def make_folder(folder: Path) -> None:
    """Create a folder that only this user can access."""
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)


def _temporary_name(name: str) -> str:
    """A name as in `atomic_file`, so that sweeping finds it."""
    return f".partial-{os.getpid()}-{secrets.token_hex(6)}-{name}"


def _is_temporary(name: str) -> bool:
    return TEMPORARY.fullmatch(name.rpartition("/")[2]) is not None


def _is_about(error: Exception, local: Path) -> bool:
    """Whether an error concerns the disk of a local file; libraries give no file name when it is full."""
    return isinstance(error, OSError) and (
        error.errno in {errno.ENOSPC, errno.EDQUOT} or str(error.filename) == str(local)
    )

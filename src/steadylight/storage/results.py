"""Results of tasks: what each returned, hashes of its outputs, and whether these are still valid."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, Protocol

from steadylight import checksum
from steadylight.atomic_file import write_json
from steadylight.errors import StorageError
from steadylight.storage.names import RunFiles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from steadylight.atomic_file import Validator


class Work(Protocol):
    """What storage needs to know about a task: its name, and its outputs relative to the run directory."""

    @property
    def key(self) -> str:
        """Name of the task."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Paths relative to the run directory."""


_TASK, _HASHES = "task", "outputs"
"""Keys of a result file that storage adds to those of the task."""


def write_result(files: RunFiles, key: str, result: Mapping[str, Any], outputs: Sequence[str] = ()) -> None:
    """Store what a task returned; see `RunDirectory.write_result`."""
    own = files.result_name(key)
    hashes = {name: file_hash(files.root / name) for name in outputs if name != own}
    content = {**result, _TASK: key, _HASHES: hashes}
    write_json(files.root / own, checksum.with_checksum(content))


def read_result(files: RunFiles, key: str) -> dict[str, Any]:
    """What a finished task returned.

    Raises:
        StorageError: there is no (readable) result of that task.
    """
    path = files.root / files.result_name(key)
    try:
        result = _parse(path, key)
    except (OSError, ValueError) as error:
        raise StorageError(
            f"{path}: the result of {key} cannot be read ({error}); run the same command again"
        ) from error
    return {name: value for name, value in result.items() if name not in {_TASK, _HASHES}}


def faults_of(
    files: RunFiles, task: Work, validators: Mapping[str, Validator]
) -> tuple[list[str], list[str]]:
    """Names of a task's missing outputs, and a sentence for each output that exists but is not valid."""
    missing, faults = [], []
    hashes = _hashes(files, task.key)
    readers = {**validators, ".json": lambda path: _parse(path, task.key)}
    for name in task.outputs:
        path = files.root / name
        if not path.is_file():
            missing.append(name)
            continue
        reason = _fault(path, readers)
        if not reason and hashes and name != files.result_name(task.key):
            reason = _difference(path, hashes.get(name))
        if reason:
            faults.append(f"{path.name} is not valid ({reason}); task {task.key} will run again")
    return missing, faults


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _hashes(files: RunFiles, key: str) -> dict[str, str]:
    """Recorded hashes of a task's outputs; empty if its result cannot be read."""
    try:
        return dict(_parse(files.root / files.result_name(key), key).get(_HASHES, {}))
    except (OSError, ValueError):
        return {}


def _parse(path: Path, key: str) -> dict[str, Any]:
    """Parse a result file.

    Raises:
        ValueError: the file is damaged, or belongs to another task.
    """
    result = checksum.parse(path.read_bytes())
    if result.get(_TASK, key) != key:
        raise ValueError(f"it is the result of task {result[_TASK]}")
    return result


def _fault(path: Path, validators: Mapping[str, Validator]) -> str:
    """Why a file is not valid; empty if it is."""
    try:
        validator = validators.get(path.suffix)
        if validator is not None:
            validator(path)
        elif path.stat().st_size == 0:
            return "it is empty"
    except Exception as error:  # noqa: BLE001 - any reader error means invalid
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return ""


def _difference(path: Path, recorded: str | None) -> str:
    """How a file differs from the recorded one; empty if it does not."""
    if recorded is None:
        return "it belongs to another task than its result"
    return "" if file_hash(path) == recorded else "its hash does not match the recorded one"

"""One attempt at a task, where it runs: performs it, measures the time, and describes a failure as text.

Only plain data leaves this module, so that a worker's exception never has to be unpickled in another process, and
results are the same on every engine.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import time
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from steadylight.errors import BackendError, InputError, SteadylightError, StorageError
from steadylight.redaction import redacted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from steadylight.engines.base import Task


@dataclass(frozen=True)
class Trial:
    """Outcome of performing a task here.

    Attributes:
        outcome: `done` or `failed`.
        seconds: wall-clock seconds.
        seconds_cpu: CPU seconds of this process during the task, all threads.
        worker: name, host and process id of this worker.
        result: what the task returned; for a failure `error` (a sentence), `details` (the traceback), `cause`
            and, for errors that the user can fix, `kind` (see `describe`).
    """

    outcome: str
    seconds: float
    seconds_cpu: float
    worker: str
    result: Mapping[str, Any]


def perform_here(perform: Callable[[Task], Mapping[str, Any]], task: Task, name: str) -> Trial:
    """Perform a task in this process and thread; exceptions of the task (`Exception`) do not propagate.

    Args:
        perform: does the work; returns a small dict of plain data (JSON).
        task: argument of `perform`.
        name: name of this worker.
    """
    start, start_cpu = time.perf_counter(), time.process_time()
    try:
        # A round trip through JSON, so that results are the same on all engines.
        result = json.loads(json.dumps(dict(perform(task))))
        outcome = "done"
    except Exception as error:  # noqa: BLE001 - any exception is a failure of the task and is passed on
        result, outcome = describe(error), "failed"
    return Trial(
        outcome=outcome,
        seconds=time.perf_counter() - start,
        seconds_cpu=time.process_time() - start_cpu,
        worker=label(name, socket.gethostname(), os.getpid()),
        result=result,
    )


def describe(error: BaseException) -> dict[str, str]:
    """A failure as plain text.

    Returns:
        `error` (a sentence), `details` (the traceback), `cause` (see `Attempt.cause`), and for errors that the user
        can fix (bad input, storage), `kind` (the class in `errors`).
    """
    # Our own errors are sentences for the user; for others, the class is part of the message.
    words = str(error) if isinstance(error, SteadylightError) else f"{type(error).__name__}: {error}"
    described = {
        "error": redacted(words),
        "details": redacted("".join(traceback.format_exception(error))),
        "cause": _cause(error),
    }
    if isinstance(error, InputError | StorageError):
        described["kind"] = type(error).__name__
    return described


# Errors of a full, read-only or broken disk. Those of the run directory are already StorageError, so these come from
# the host's scratch space.
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ENOMEM, errno.EMFILE, errno.ENFILE}


def _cause(error: BaseException) -> str:
    """Cause of a failure, as far as the error shows."""
    if isinstance(error, InputError):
        return "input"
    if isinstance(error, StorageError):
        return "storage"
    if isinstance(error, BackendError | ImportError | MemoryError):
        return "host"
    if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
        return "host"
    return "task"


def label(name: str, host: str, process: int | str) -> str:
    """Name of a worker in the journal: `worker-1 host:4711`."""
    return f"{name} {host}:{process}"


def machine_of(worker: str) -> str:
    """Host of a worker, from its name in the journal; the name itself if it contains no host."""
    return worker.rpartition(" ")[2].partition(":")[0]

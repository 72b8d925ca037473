"""A bundle of tasks in the worker process: one after the other, each reported to the command as it ends."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from distributed import get_worker
from distributed.utils import sync

from steadylight.engines.performing import perform_here

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from distributed import Worker

    from steadylight.engines.base import Task


def perform_bundle(
    perform: Callable[[Task], Mapping[str, Any]], bundle: Sequence[tuple[str, Task]], topic: str
) -> None:
    """Perform the tasks of a bundle and report each one."""
    worker = get_worker()
    for key, task in bundle:
        if not _is_wanted(worker, bundle[0][0]):
            return
        trial = perform_here(perform, task, str(worker.name))
        _report(worker, topic, json.dumps(asdict(trial) | {"key": key}))


def _is_wanted(worker: Worker, key: str) -> bool:
    """Whether a running bundle was not cancelled: Dask lets cancelled tasks run on and ignores their results."""
    task = worker.state.tasks.get(key)
    return task is not None and task.state != "cancelled"


def _report(worker: Worker, topic: str, words: str) -> None:
    """Report to the command, and wait until the scheduler has the report: the next task may kill this process."""
    try:
        sync(worker.loop, worker.scheduler.log_event, topic=topic, msg=words)
    except OSError:
        # The worker's main connection may still work; a duplicate report does no harm.
        worker.log_event(topic, words)

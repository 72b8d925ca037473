"""Work for engines that needs no renderer: module-level functions, so that workers can import them."""

import os
import signal
import time
from functools import partial
from pathlib import Path

from steadylight.engines import Task
from steadylight.errors import BackendError, SceneError


def task(key: str, *needs: str, **arguments: object) -> Task:
    return Task(key, key.split("-", maxsplit=1)[0], (f"{key}.txt",), needs, arguments)


def total(task: Task, folder: Path) -> dict:
    """Write the sum of a number and what the needs wrote; count how often that was done."""
    value = task.arguments.get("value", 0) + sum(
        int((folder / f"{need}.txt").read_text()) for need in task.needs
    )
    (folder / task.outputs[0]).write_text(str(value))
    with (folder / "performed.log").open("a") as log:
        log.write(f"{task.key}\n")
    return {"value": value, "pair": (1, 2)}


def fail(task: Task, folder: Path) -> dict:
    """Fail as often as the task's arguments say."""
    marks = list(folder.glob(f"{task.key}.failed*"))
    if len(marks) < task.arguments.get("failures", 0):
        (folder / f"{task.key}.failed{len(marks)}").touch()
        raise ZeroDivisionError("no light")
    return total(task, folder)


def find_input_wrong(task: Task) -> dict:
    raise SceneError(f"temple.xml: line 3: unknown plugin {task.key}")


def find_no_compiler(task: Task) -> dict:
    raise BackendError("no LLVM")


def return_what_is_not_plain(task: Task) -> dict:
    return {"value": object()}


def die(task: Task, folder: Path) -> dict:
    """Kill the worker as often as the task's arguments say."""
    marks = list(folder.glob(f"{task.key}.died*"))
    if len(marks) < task.arguments.get("deaths", 0):
        (folder / f"{task.key}.died{len(marks)}").touch()
        os.write(2, b"famous last words\n")
        os.kill(os.getpid(), signal.SIGKILL)
    return total(task, folder)


def note_overlap(task: Task, folder: Path) -> dict:
    """Tell whether another task runs in this process."""
    mark = folder / f"running-{os.getpid()}"
    alone = not mark.exists()
    mark.touch()
    time.sleep(0.05)
    mark.unlink(missing_ok=True)
    return {"alone": alone}


def report_process(task: Task) -> dict:
    import sys

    heavy = {"mitsuba", "drjit", "matplotlib", "trimesh"} & set(sys.modules)
    return {"pid": os.getpid(), "heavy": sorted(heavy)}


def burn(task: Task) -> dict:
    end = time.process_time() + 0.2
    while time.process_time() < end:
        pass
    return {}


def stay(task: Task, folder: Path) -> dict:
    """Say who runs here, and go on for ten minutes, asleep or busy."""
    (folder / f"{task.key}.tmp").write_text(f"{os.getpid()} {Path('/proc/self/fd/1').readlink().parent}")
    (folder / f"{task.key}.tmp").replace(folder / f"{task.key}.pid")
    end = time.monotonic() + 600
    while time.monotonic() < end:
        if task.arguments.get("asleep"):
            time.sleep(600)
    return {}


def stay_or_total(task: Task, folder: Path) -> dict:
    """Tasks of the stage `slow` stay, the others add."""
    return (stay if task.stage == "slow" else total)(task, folder)


def stay_or_kill(task: Task, folder: Path) -> dict:
    """Tasks of the stage `b` kill the scheduler, the others would go on."""
    if task.stage == "b":
        os.kill(int((folder / "scheduler.pid").read_text()), signal.SIGKILL)
    return stay(task, folder)


def total_unless_poisoned(task: Task, folder: Path, poisoned: str) -> dict:
    """Fail at once on one host."""
    if os.environ["HOST_NAME"] == poisoned:
        raise RuntimeError("this host is poisoned")
    time.sleep(task.arguments.get("seconds", 0.0))
    return total(task, folder)


def sleep(task: Task, folder: Path) -> dict:
    time.sleep(task.arguments["seconds"])
    return total(task, folder)


def stall_once(task: Task, folder: Path) -> dict:
    """The first time, stop this process: it is there, and does nothing."""
    mark = folder / "stalled"
    if task.arguments.get("stalls", task.stage == "a") and not mark.exists():
        mark.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGSTOP)
        # The signal may reach another thread first.
        time.sleep(0.1)
    end = time.monotonic() + task.arguments.get("seconds", 0.0)
    while time.monotonic() < end:
        pass
    return total(task, folder)


def in_folder(work, folder: Path):
    return partial(work, folder=folder)

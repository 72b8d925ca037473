"""Engines to run the same tests on, and a cluster that is not ours."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from steadylight.engines.dask_cluster import DaskCluster
from steadylight.engines.in_process import InProcess


@pytest.fixture(scope="session")
def importing_environment():
    """Environment of a process that finds the modules that this one finds."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


class ForeignCluster:
    """A scheduler and workers as an administrator would start them: not by steadylight."""

    def __init__(self, folder: Path, environment: dict[str, str], workers: int) -> None:
        self.folder = folder
        self.environment = environment
        self.scheduler_file = folder / "scheduler.json"
        self.processes = [
            self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show")
        ]
        for number in range(workers):
            self.start_worker(number)

    def start(self, what: str, *arguments: str) -> subprocess.Popen:
        command = [
            sys.executable,
            "-m",
            "dask",
            what,
            "--scheduler-file",
            str(self.scheduler_file),
            *arguments,
        ]
        with (self.folder / f"{what}.log").open("ab") as log:
            return subprocess.Popen(command, stdout=log, stderr=log, env=self.environment, cwd=self.folder)

    def start_worker(self, number: int) -> None:
        options = ["--nthreads", "4", "--no-nanny", "--no-dashboard", "--memory-limit", "0"]
        self.processes.append(self.start("worker", *options, "--name", f"foreign-{number}"))

    @property
    def address(self) -> str:
        import json

        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            try:
                return json.loads(self.scheduler_file.read_text())["address"]
            except (OSError, ValueError):
                time.sleep(0.05)
        raise TimeoutError((self.folder / "scheduler.log").read_text())

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="session")
def foreign_cluster(tmp_path_factory, importing_environment):
    cluster = ForeignCluster(tmp_path_factory.mktemp("foreign"), importing_environment, workers=2)
    yield cluster
    cluster.close()


@pytest.fixture(scope="module", params=["in-process", "one worker", "two workers", "address"])
def engine(request):
    """Every engine, with an attempt limit of 3."""
    if request.param == "in-process":
        made = InProcess(attempts=3)
    elif request.param == "address":
        made = DaskCluster(cluster=request.getfixturevalue("foreign_cluster").address, attempts=3)
    else:
        made = DaskCluster(workers=1 if request.param == "one worker" else 2, attempts=3)
    with made:
        yield made

"""A Dask cluster that is not ours, for tests."""

import json
import subprocess
import sys
import time
from pathlib import Path


class ForeignCluster:
    """A scheduler and workers as an administrator would start them: not by steadylight."""

    def __init__(
        self, folder: Path, environment: dict[str, str], workers: int, *options: str, protocol: str = "tcp"
    ) -> None:
        self.folder = folder
        self.environment = environment
        self.scheduler_file = folder / "scheduler.json"
        self.options = options
        place = ("--host", "127.0.0.1", "--port", "0", "--protocol", protocol)
        self.processes = [self.start("scheduler", *place, "--no-dashboard", "--no-show")]
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
            *self.options,
            *arguments,
        ]
        with (self.folder / f"{what}.log").open("ab") as log:
            return subprocess.Popen(command, stdout=log, stderr=log, env=self.environment, cwd=self.folder)

    def start_worker(self, number: int, *more: str) -> None:
        options = [*more, "--nthreads", "4", "--no-nanny", "--no-dashboard", "--memory-limit", "0"]
        self.processes.append(self.start("worker", *options, "--name", f"foreign-{number}"))

    @property
    def address(self) -> str:
        deadline = time.monotonic() + 120
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

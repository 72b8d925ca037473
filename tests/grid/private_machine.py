"""A machine of its own for a batch system: name spaces in which its daemons run, and which end with the test.

Network, host name, process numbers and mounts are private, so that daemons of several tests and of the real machine
never meet, and nothing of them is left behind.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ADDRESS = "10.77.0.1"
SPACES = ("--mount", "--uts", "--net", "--pid")


def missing(*programs):
    """Why no private machine with these programs can be had here; empty if it can."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "needs root, to start the daemons of a batch system in name spaces of their own"
    absent = [
        name for name in ("setpriv", "unshare", "nsenter", "ip", *programs) if shutil.which(name) is None
    ]
    if absent:
        return f"not installed: {', '.join(absent)}"
    made = subprocess.run(["unshare", *SPACES, "--fork", "true"], capture_output=True, check=False)
    return "" if made.returncode == 0 else "this machine gives no name spaces"


class PrivateMachine:
    """A machine named `name` with one address that is not loopback's."""

    def __init__(self, folder: Path, name: str, setup: str) -> None:
        """Start it.

        Args:
            folder: for what the set-up says.
            name: of the host.
            setup: shell lines that start the daemons.
        """
        self.folder = folder
        self.log = folder / "machine.log"
        hosts = folder / "hosts"
        hosts.write_text(f"127.0.0.1 localhost\n{ADDRESS} {name}\n")
        ready = folder / "ready"
        script = folder / "machine.sh"
        script.write_text(
            f"set -eu\nhostname {name}\nmount --bind {hosts} /etc/hosts\n"
            f"ip link set lo up\nip addr add {ADDRESS}/32 dev lo\n{setup}\ntouch {ready}\nexec sleep infinity\n"
        )
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [
                    "setpriv",
                    "--pdeathsig",
                    "KILL",
                    "unshare",
                    *SPACES,
                    "--mount-proc",
                    "--fork",
                    "--kill-child",
                    "bash",
                    "-x",
                    script,
                ],
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        self.wait_until(ready.exists, 40)

    def wait_until(self, condition, seconds=30.0):
        """Wait; on failure say what the machine said."""
        end = time.monotonic() + seconds
        while not condition():
            assert self.process.poll() is None, self.log.read_text(errors="replace")[-4000:]
            assert time.monotonic() < end, self.log.read_text(errors="replace")[-4000:]
            time.sleep(0.1)

    @property
    def init(self) -> int:
        """Process number, on the real machine, of the first process of the private one."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return int(children[0])

    def command(self, *words, user=None):
        """A command line that runs `words` on this machine."""
        inside = ["nsenter", "--target", str(self.init), *SPACES]
        if user is not None:
            inside += ["runuser", "-u", user, "--"]
        return [*inside, *map(str, words)]

    def run(self, *words, user=None, **options):
        """Run a command here and return what it printed."""
        done = subprocess.run(
            self.command(*words, user=user), capture_output=True, text=True, check=False, **options
        )
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout

    def start(self, *words, user=None, **options):
        """Start a command here."""
        return subprocess.Popen(
            self.command(*words, user=user),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            **options,
        )

    def close(self):
        """End everything that runs here."""
        os.kill(self.init, signal.SIGKILL)
        self.process.wait(20)


def environment():
    """For a command that finds the modules that this process finds, and the program's own log quiet."""
    path = os.pathsep.join(part for part in sys.path if part)
    return {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}

"""What clusters do to a run: things that befall it, and what must hold afterwards."""

from __future__ import annotations

import random
import signal
import time

import psutil
from cheap_film import performed
from private_machine import environment

from small_film import digests, journal


class Disturbed:
    """A run on a machine, and what can befall it."""

    def __init__(self, machine, process, directory):
        self.machine = machine
        self.process = process
        self.directory = directory

    def call(self, *words):
        return self.machine.run(*words, env=environment() | self.machine.environment)

    def some_worker(self, chance):
        """Process number of a worker that is alive, as the private machine counts."""
        workers = {int(entry["worker"].rpartition(":")[2]) for entry in journal(self.directory)}
        alive = sorted(workers.intersection(map(int, self.call("ps", "-eo", "pid=").split())))
        assert alive, (
            f"none of the workers {sorted(workers)} is left: the film was over before it could be disturbed"
        )
        return chance.choice(alive)

    def kill_worker(self, chance):
        self.call("kill", "-9", self.some_worker(chance))

    def kill_nanny(self, chance):
        self.call("kill", "-9", self.call("ps", "-o", "ppid=", "-p", self.some_worker(chance)).strip())

    def stop_worker(self, chance):
        """It hangs: it is there, and does nothing."""
        self.call("kill", "-STOP", self.some_worker(chance))

    def cancel_job(self, chance):
        self.machine.cancel(chance.choice(sorted(self.machine.jobs())))

    def kill_command(self, _chance):
        """With the command goes the scheduler process, which is a part of it."""
        for child in psutil.Process(self.process.pid).children(recursive=True):
            child.send_signal(signal.SIGKILL)

    def kill_daemons(self, _chance):
        """A node's daemon goes, with those that watch over its jobs, and comes back."""
        self.machine.kill_daemons()


def disturb(machine, start, directory, *, fault, seed, between, pause):
    """Start a film, let something happen at a random instant, and give the command again until it is done.

    Args:
        machine: where.
        start: starts the command.
        directory: of the run.
        fault: name of one of the methods of `Disturbed`.
        seed: of the instant, and of the victim.
        between: least and most tasks done before it happens.
        pause: most seconds that pass from then.

    Returns:
        What each command said.
    """
    chance = random.Random(seed)
    process = start()
    run = Disturbed(machine, process, directory)
    after = chance.randint(*between)
    machine.wait_until(lambda: len(journal(directory)) >= after or process.poll() is not None, 300)
    assert process.poll() is None, process.communicate()[0]
    time.sleep(chance.uniform(0, pause))
    getattr(run, fault)(chance)
    before = finished(directory)
    said = [process.communicate(timeout=600)[0]]
    while process.returncode != 0 and len(said) < 3:
        process = start()
        said.append(process.communicate(timeout=600)[0])
    assert process.returncode == 0, "\n".join(said)
    assert before.items() <= finished(directory).items()
    return said


def finished(directory):
    """Times of change of the outputs of all tasks that have a result: these are never written again."""
    keys = {path.stem for path in directory.glob("log/results/[!.]*.json")}
    names = [f"frames/frame_{key[6:]}.exr" for key in keys if key.startswith("shade-")]
    return {name: (directory / name).stat().st_mtime_ns for name in names}


def check(directory, expected):
    """All frames and caches with the right bytes, nothing half-written, and no finished task done again."""
    assert digests(directory) == expected
    assert not list(directory.rglob(".partial-*"))
    assert not list(directory.glob("log/batch/wanted-*"))
    done = [entry["task"] for entry in journal(directory) if entry["outcome"] == "done"]
    assert len(done) == len(set(done))
    noted = performed(directory)
    assert len(noted) == len(set(noted))

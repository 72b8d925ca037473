"""What clusters do to a run, at random instants from a seed: every run ends with all frames and the same bytes.

A run may stop; the same command again then goes on. Nothing that was finished is done again.
"""

from __future__ import annotations

import random
import signal
import time

import psutil
import pytest
from cheap_film import performed
from private_machine import environment

from small_film import digests, journal

FRAMES = 16
SECONDS = 0.3


class Disturbed:
    """A run on a machine, and what can befall it."""

    def __init__(self, machine, process, directory):
        self.machine = machine
        self.process = process
        self.directory = directory

    def call(self, *words):
        return self.machine.run(*words, env=environment() | self.machine.environment)

    def some_worker(self, chance):
        """Process number of a worker, as the private machine counts."""
        workers = sorted({entry["worker"] for entry in journal(self.directory)})
        return int(chance.choice(workers).rpartition(":")[2])

    def kill_worker(self, chance):
        self.call("kill", "-9", self.some_worker(chance))

    def kill_nanny(self, chance):
        self.call("kill", "-9", self.call("ps", "-o", "ppid=", "-p", self.some_worker(chance)).strip())

    def stop_worker(self, chance):
        """It hangs: it is there, and does nothing."""
        self.call("kill", "-STOP", self.some_worker(chance))

    def cancel_job(self, chance):
        self.call("scancel", chance.choice(sorted(self.machine.jobs())))

    def kill_command(self, _chance):
        """With the command goes the scheduler process, which is a part of it."""
        for child in psutil.Process(self.process.pid).children(recursive=True):
            child.send_signal(signal.SIGKILL)

    def kill_slurmd(self, _chance):
        """A node's daemon goes, with those that watch over its jobs, and comes back."""
        self.call("pkill", "-9", "slurmd")
        self.call("pkill", "-9", "slurmstepd")
        time.sleep(2)
        for node in ("n1", "n2"):
            self.call("slurmd", "-N", node)


@pytest.fixture
def calm(slurm):
    """The machine, with nothing left of the test before."""
    yield slurm
    variables = environment() | slurm.environment
    slurm.run("scancel", "--user=root", env=variables)
    slurm.wait_until(lambda: not slurm.run("squeue", "--noheader", env=variables).strip(), 60)
    state = ("sinfo", "--noheader", "--format=%t%D")
    slurm.wait_until(lambda: slurm.run(*state, env=variables).strip() == "idle2", 60)


def disturb(machine, site_file, start, directory, *, fault, seed, seconds=SECONDS):
    """Start the film, let something happen at a random instant, and give the command again until it is done."""
    chance = random.Random(seed)
    options = ("--site", site_file, "--frames", FRAMES, "--seconds", seconds)
    process = start(machine, directory, "slurm", *options)
    run = Disturbed(machine, process, directory)
    after = chance.randrange(8, FRAMES + 6)
    machine.wait_until(lambda: len(journal(directory)) >= after or process.poll() is not None, 60)
    assert process.poll() is None, process.communicate()[0]
    time.sleep(chance.uniform(0, 2 * seconds))
    getattr(run, fault)(chance)
    before = finished(directory)
    said = [process.communicate(timeout=150)[0]]
    while process.returncode != 0 and len(said) < 3:
        process = start(machine, directory, "slurm", *options)
        said.append(process.communicate(timeout=150)[0])
    assert process.returncode == 0, "\n".join(said)
    assert before.items() <= finished(directory).items()
    return said


def finished(directory):
    """Times of change of the outputs of all tasks that have a result: these are never written again."""
    keys = {path.stem for path in directory.glob("log/results/*.json")}
    names = [f"frames/frame_{key[6:]}.exr" for key in keys if key.startswith("shade-")]
    return {name: (directory / name).stat().st_mtime_ns for name in names}


def check(directory, expected):
    assert digests(directory) == expected
    assert not list(directory.rglob(".partial-*"))
    assert not list(directory.glob("log/batch/wanted-*"))
    done = [entry["task"] for entry in journal(directory) if entry["outcome"] == "done"]
    assert len(done) == len(set(done))
    noted = performed(directory)
    assert len(noted) == len(set(noted))


@pytest.mark.parametrize(
    ("fault", "seed"),
    [
        ("kill_worker", 1),
        pytest.param("cancel_job", 2, marks=pytest.mark.slow),
        pytest.param("kill_worker", 3, marks=pytest.mark.slow),
        pytest.param("kill_worker", 4, marks=pytest.mark.slow),
        pytest.param("kill_nanny", 5, marks=pytest.mark.slow),
        pytest.param("kill_nanny", 6, marks=pytest.mark.slow),
        pytest.param("cancel_job", 7, marks=pytest.mark.slow),
        pytest.param("stop_worker", 8, marks=pytest.mark.slow),
        pytest.param("stop_worker", 9, marks=pytest.mark.slow),
        pytest.param("kill_slurmd", 10, marks=pytest.mark.slow),
        pytest.param("kill_slurmd", 11, marks=pytest.mark.slow),
    ],
)
def test_a_run_outlives_its_workers(  # noqa: PLR0917 - fixtures
    calm, site, start, undisturbed, fault, seed
):
    directory = calm.work / f"{fault}-{seed}"
    site_file = site(calm, faults={"stalled_after": 5.0})
    said = disturb(calm, site_file, start, directory, fault=fault, seed=seed)
    assert len(said) == 1, "\n".join(said)
    check(directory, undisturbed(FRAMES))
    causes = {entry["cause"] for entry in journal(directory) if entry["outcome"] != "done"}
    assert causes <= {"hung" if fault == "stop_worker" else "lost"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22])
def test_a_killed_command_leaves_no_jobs_and_the_same_command_goes_on(calm, site, start, undisturbed, seed):
    directory = calm.work / f"kill-command-{seed}"
    said = disturb(calm, site(calm), start, directory, fault="kill_command", seed=seed)
    assert len(said) == 2
    check(directory, undisturbed(FRAMES))
    # The workers of the killed command saw their scheduler go.
    calm.wait_until(lambda: not calm.jobs(), 60)


@pytest.mark.slow
def test_jobs_whose_walltime_is_shorter_than_the_run_are_replaced(calm, site, start, undisturbed):
    directory = calm.work / "walltime"
    options = ("--site", site(calm, walltime="00:01:00"), "--frames", FRAMES, "--seconds", 16)
    process = start(calm, directory, "slurm", *options)
    said, _ = process.communicate(timeout=400)
    assert process.returncode == 0, said
    check(directory, undisturbed(FRAMES))
    workers = {entry["worker"].split()[0] for entry in journal(directory)}
    assert len(workers) > 2
    assert {entry.get("cause", "walltime") for entry in journal(directory)} == {"walltime"}


@pytest.mark.slow
def test_a_second_command_is_refused_while_the_first_goes_on(calm, site, start, undisturbed):
    directory = calm.work / "two"
    options = ("--site", site(calm), "--frames", FRAMES, "--seconds", 3)
    first = start(calm, directory, "slurm", *options)
    calm.wait_until(lambda: len(journal(directory)) > 3, 60)
    second = start(calm, directory, "slurm", *options)
    said, _ = second.communicate(timeout=60)
    assert second.returncode == 2
    assert "another steadylight command is at work here" in said
    words, _ = first.communicate(timeout=100)
    assert first.returncode == 0, words
    check(directory, undisturbed(FRAMES))

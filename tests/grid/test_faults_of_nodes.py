"""What nodes do to a run, at random instants from a seed: every run ends with all frames and the same bytes.

A run may stop; the same command again then goes on. Nothing that was finished is done again.
"""

from __future__ import annotations

from functools import partial

import pytest
from disturbing import check, disturb

from small_film import journal

FRAMES = 16
SECONDS = 0.3
OPTIONS = ("--frames", FRAMES, "--seconds", SECONDS)
INSTANTS = {"between": (8, FRAMES + 5), "pause": 2 * SECONDS}
slow = pytest.mark.slow


@pytest.fixture
def calm(request, name):
    """The machine of the batch system `name`, with nothing left of the test before."""
    machine = request.getfixturevalue(name)
    yield machine
    machine.clear()


@pytest.mark.parametrize(
    ("name", "fault", "seed"),
    [
        ("slurm", "kill_worker", 1),
        pytest.param("slurm", "cancel_job", 2, marks=slow),
        pytest.param("slurm", "kill_worker", 3, marks=slow),
        pytest.param("slurm", "kill_worker", 4, marks=slow),
        pytest.param("slurm", "kill_nanny", 5, marks=slow),
        pytest.param("slurm", "kill_nanny", 6, marks=slow),
        pytest.param("slurm", "cancel_job", 7, marks=slow),
        pytest.param("slurm", "stop_worker", 8, marks=slow),
        pytest.param("slurm", "stop_worker", 9, marks=slow),
        pytest.param("slurm", "kill_daemons", 10, marks=slow),
        pytest.param("slurm", "kill_daemons", 11, marks=slow),
        ("sge", "kill_worker", 31),
        pytest.param("sge", "kill_worker", 32, marks=slow),
        pytest.param("sge", "kill_nanny", 33, marks=slow),
        pytest.param("sge", "cancel_job", 34, marks=slow),
        pytest.param("sge", "cancel_job", 35, marks=slow),
        pytest.param("sge", "stop_worker", 36, marks=slow),
        pytest.param("sge", "kill_daemons", 37, marks=slow),
    ],
)
def test_a_run_outlives_its_workers(  # noqa: PLR0917 - fixtures
    calm, site, start, undisturbed, name, fault, seed
):
    directory = calm.work / f"{fault}-{seed}"
    # Only where a worker hangs shall patience be short: on a busy machine others can be silent for seconds.
    faults = {"stalled_after": 15.0} if fault == "stop_worker" else {}
    command = partial(start, calm, directory, name, "--site", site(calm, faults=faults), *OPTIONS)
    said = disturb(calm, command, directory, fault=fault, seed=seed, **INSTANTS)
    assert len(said) == 1, "\n".join(said)
    check(directory, undisturbed(FRAMES))
    causes = {entry["cause"] for entry in journal(directory) if entry["outcome"] != "done"}
    assert causes <= {"hung" if fault == "stop_worker" else "lost"}


@slow
@pytest.mark.parametrize(("name", "seed"), [("slurm", 21), ("slurm", 22), ("sge", 41)])
def test_a_killed_command_leaves_no_jobs_and_the_same_command_goes_on(
    calm, site, start, undisturbed, name, seed
):
    directory = calm.work / f"kill-command-{seed}"
    command = partial(start, calm, directory, name, "--site", site(calm), *OPTIONS)
    said = disturb(calm, command, directory, fault="kill_command", seed=seed, **INSTANTS)
    assert len(said) == 2
    check(directory, undisturbed(FRAMES))
    # The workers of the killed command saw their scheduler go.
    calm.wait_until(lambda: not calm.jobs(), 240)


@slow
@pytest.mark.parametrize("name", ["slurm"])
def test_jobs_whose_walltime_is_shorter_than_the_run_are_replaced(calm, site, start, undisturbed, name):
    directory = calm.work / "walltime"
    options = ("--site", site(calm, walltime="00:01:00"), "--frames", FRAMES, "--seconds", 16)
    process = start(calm, directory, name, *options)
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    check(directory, undisturbed(FRAMES))
    workers = {entry["worker"].split()[0] for entry in journal(directory)}
    assert len(workers) > 2
    assert {entry.get("cause", "walltime") for entry in journal(directory)} == {"walltime"}


@slow
@pytest.mark.parametrize("name", ["slurm"])
def test_a_second_command_is_refused_while_the_first_goes_on(calm, site, start, undisturbed, name):
    directory = calm.work / "two"
    options = ("--site", site(calm), "--frames", FRAMES, "--seconds", 3)
    first = start(calm, directory, name, *options)
    calm.wait_until(lambda: len(journal(directory)) > 3, 240)
    second = start(calm, directory, name, *options)
    said, _ = second.communicate(timeout=240)
    assert second.returncode == 2
    assert "another steadylight command is using this run" in said
    words, _ = first.communicate(timeout=400)
    assert first.returncode == 0, words
    check(directory, undisturbed(FRAMES))

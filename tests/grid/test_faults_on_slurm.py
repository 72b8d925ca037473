"""What Slurm's nodes do to a run, at random instants from a seed: every run ends with all frames and the same bytes.

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


@pytest.fixture
def calm(slurm):
    """The machine, with nothing left of the test before."""
    yield slurm
    slurm.clear()


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
        pytest.param("kill_daemons", 10, marks=pytest.mark.slow),
        pytest.param("kill_daemons", 11, marks=pytest.mark.slow),
    ],
)
def test_a_run_outlives_its_workers(  # noqa: PLR0917 - fixtures
    calm, site, start, undisturbed, fault, seed
):
    directory = calm.work / f"{fault}-{seed}"
    site_file = site(calm, faults={"stalled_after": 5.0})
    command = partial(start, calm, directory, "slurm", "--site", site_file, *OPTIONS)
    said = disturb(calm, command, directory, fault=fault, seed=seed, **INSTANTS)
    assert len(said) == 1, "\n".join(said)
    check(directory, undisturbed(FRAMES))
    causes = {entry["cause"] for entry in journal(directory) if entry["outcome"] != "done"}
    assert causes <= {"hung" if fault == "stop_worker" else "lost"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22])
def test_a_killed_command_leaves_no_jobs_and_the_same_command_goes_on(calm, site, start, undisturbed, seed):
    directory = calm.work / f"kill-command-{seed}"
    command = partial(start, calm, directory, "slurm", "--site", site(calm), *OPTIONS)
    said = disturb(calm, command, directory, fault="kill_command", seed=seed, **INSTANTS)
    assert len(said) == 2
    check(directory, undisturbed(FRAMES))
    # The workers of the killed command saw their scheduler go.
    calm.wait_until(lambda: not calm.jobs(), 240)


@pytest.mark.slow
def test_jobs_whose_walltime_is_shorter_than_the_run_are_replaced(calm, site, start, undisturbed):
    directory = calm.work / "walltime"
    options = ("--site", site(calm, walltime="00:01:00"), "--frames", FRAMES, "--seconds", 16)
    process = start(calm, directory, "slurm", *options)
    said, _ = process.communicate(timeout=600)
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
    calm.wait_until(lambda: len(journal(directory)) > 3, 240)
    second = start(calm, directory, "slurm", *options)
    said, _ = second.communicate(timeout=240)
    assert second.returncode == 2
    assert "another steadylight command is at work here" in said
    words, _ = first.communicate(timeout=400)
    assert first.returncode == 0, words
    check(directory, undisturbed(FRAMES))

"""What Grid Engine's host does to a run, at random instants from a seed: as on Slurm, the bytes stay the same."""

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
def calm(sge):
    """The machine, with nothing left of the test before."""
    yield sge
    sge.clear()


@pytest.mark.parametrize(
    ("fault", "seed"),
    [
        ("kill_worker", 31),
        pytest.param("kill_worker", 32, marks=pytest.mark.slow),
        pytest.param("kill_nanny", 33, marks=pytest.mark.slow),
        pytest.param("cancel_job", 34, marks=pytest.mark.slow),
        pytest.param("cancel_job", 35, marks=pytest.mark.slow),
        pytest.param("stop_worker", 36, marks=pytest.mark.slow),
        pytest.param("kill_daemons", 37, marks=pytest.mark.slow),
    ],
)
def test_a_run_outlives_its_workers(  # noqa: PLR0917 - fixtures
    calm, site, start, undisturbed, fault, seed
):
    directory = calm.work / f"{fault}-{seed}"
    site_file = site(calm, faults={"stalled_after": 5.0})
    command = partial(start, calm, directory, "sge", "--site", site_file, *OPTIONS)
    said = disturb(calm, command, directory, fault=fault, seed=seed, **INSTANTS)
    assert len(said) == 1, "\n".join(said)
    check(directory, undisturbed(FRAMES))
    causes = {entry["cause"] for entry in journal(directory) if entry["outcome"] != "done"}
    assert causes <= {"hung" if fault == "stop_worker" else "lost"}


@pytest.mark.slow
def test_a_killed_command_leaves_no_jobs_and_the_same_command_goes_on(calm, site, start, undisturbed):
    directory = calm.work / "kill-command"
    command = partial(start, calm, directory, "sge", "--site", site(calm), *OPTIONS)
    said = disturb(calm, command, directory, fault="kill_command", seed=41, **INSTANTS)
    assert len(said) == 2
    check(directory, undisturbed(FRAMES))
    # The workers of the killed command saw their scheduler go.
    calm.wait_until(lambda: not calm.jobs(), 240)

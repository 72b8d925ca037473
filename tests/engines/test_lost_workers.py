"""Workers that die, parents that die, clusters that go away: nothing is lost and nothing stays."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from arithmetic import die, in_folder, stall_once, stay_or_kill, stay_or_total, task, total
from foreign_cluster import ForeignCluster

from steadylight.engines.dask_cluster import DaskCluster
from steadylight.engines.local_workers import LocalWorkers
from steadylight.engines.pools import ForeignWorkers
from steadylight.engines.private_folder import PREFIX
from steadylight.errors import RunError, TaskFailed


def wait_until(condition, seconds: float = 120.0) -> bool:
    """Whether the condition comes true in time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.05)
    return False


def alive(process: int) -> bool:
    try:
        # A process that ended but was not waited for yet is not alive.
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


class TestKilledWorker:
    @pytest.mark.parametrize("workers", [1, 2])
    def test_only_the_task_that_ran_there_is_lost_and_it_is_done_in_the_end(self, tmp_path, workers):
        tasks = [task("a-1"), task("b-1", deaths=1), *(task(f"c-{number}") for number in range(6))]
        with DaskCluster(workers) as engine:
            # Short tasks first, so that others wait at the worker behind the one that kills it.
            list(engine.run([task(f"b-{n}") for n in (8, 9)], in_folder(total, tmp_path)))
            attempts = list(engine.run(tasks, in_folder(die, tmp_path)))
        lost = [attempt for attempt in attempts if attempt.outcome != "done"]
        assert [(attempt.task.key, attempt.outcome, attempt.attempt) for attempt in lost] == [
            ("b-1", "lost", 1)
        ]
        assert "killed by signal 9 (SIGKILL)" in lost[0].result["error"]
        assert "famous last words" in lost[0].result["error"]
        assert lost[0].worker.startswith("worker-")
        done = {attempt.task.key: attempt.attempt for attempt in attempts if attempt.outcome == "done"}
        assert done == {each.key: 2 if each.key == "b-1" else 1 for each in tasks}

    @pytest.mark.parametrize("workers", [1, 2])
    def test_one_that_ends_between_listing_and_replacing_is_lost_like_any_other(
        self, tmp_path, workers, monkeypatch
    ):
        stalled, tend = tmp_path / "stalled", LocalWorkers.tend

        def kill_and_tend(pool, registered, workload):
            if workload.busy and stalled.exists():
                for place in pool._places:
                    if str(place.process.pid) == stalled.read_text():
                        place.process.kill()
                        place.process.wait()
            tend(pool, registered, workload)

        monkeypatch.setattr(LocalWorkers, "tend", kill_and_tend)
        tasks = [task(f"a-{number:03d}", stalls=number == 17) for number in range(60)]
        with DaskCluster(workers) as engine:
            attempts = list(engine.run(tasks, in_folder(stall_once, tmp_path)))
        lost = [attempt for attempt in attempts if attempt.outcome != "done"]
        assert [(attempt.task.key, attempt.outcome, attempt.cause) for attempt in lost] == [
            ("a-017", "lost", "lost")
        ]
        assert "killed by signal 9 (SIGKILL)" in lost[0].result["error"]
        done = {attempt.task.key: attempt.attempt for attempt in attempts if attempt.outcome == "done"}
        assert done == {each.key: 2 if each.key == "a-017" else 1 for each in tasks}

    def test_losses_are_not_charged_as_failures(self, tmp_path):
        with DaskCluster(attempts=1) as engine:
            attempts = list(engine.run([task("a-1", deaths=2)], in_folder(die, tmp_path)))
        assert [attempt.outcome for attempt in attempts] == ["lost", "lost", "done"]

    def test_a_task_that_keeps_killing_workers_ends_the_run_with_a_word_about_memory(self, tmp_path):
        seen = []
        with DaskCluster() as engine, pytest.raises(TaskFailed, match="too little memory") as caught:
            seen.extend(engine.run([task("a-1", deaths=99)], in_folder(die, tmp_path)))
        assert caught.value.key == "a-1"
        assert "died 4 times" in str(caught.value)

    def test_a_worker_killed_between_tasks_is_replaced(self, tmp_path):
        with DaskCluster() as engine:
            (first,) = engine.run([task("a-1")], in_folder(total, tmp_path))
            os.kill(int(first.worker.rsplit(":", 1)[1]), signal.SIGKILL)
            attempts = list(engine.run([task("a-2")], in_folder(total, tmp_path)))
        assert attempts[-1].outcome == "done"
        assert attempts[-1].worker != first.worker

    def test_workers_that_cannot_start_are_an_error_with_their_words(self, tmp_path, monkeypatch):
        python = tmp_path / "python"
        python.write_text("#!/bin/sh\necho cannot load a library\nexit 3\n")
        python.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(python))
        with (
            DaskCluster() as engine,
            pytest.raises(
                RunError, match=r"cannot start: .* exit code 3; last output: cannot load a library"
            ),
        ):
            list(engine.run([task("a-1")], in_folder(total, tmp_path)))

    def test_a_broken_end_kills_local_workers_that_are_still_busy(self, tmp_path):
        with DaskCluster(2) as engine:
            tasks = [task("fast-1"), task("slow-1")]
            for _ in engine.run(tasks, in_folder(stay_or_total, tmp_path)):
                assert wait_until((tmp_path / "slow-1.pid").exists)
                break
            process = int((tmp_path / "slow-1.pid").read_text().split()[0])
            assert wait_until(lambda: not alive(process), 60)


RUN_FOR_LONG = """
import sys
from pathlib import Path
from arithmetic import in_folder, stay, task
from steadylight.engines.dask_cluster import DaskCluster

# No guard against being imported: workers must not run their parent's script.
with DaskCluster(workers=2) as engine:
    tasks = [task("asleep-1", asleep=True), task("busy-1"), task("c-1"), task("c-2")]
    for attempt in engine.run(tasks, in_folder(stay, Path(sys.argv[1]))):
        print(attempt)
"""


@pytest.fixture
def long_run(tmp_path, importing_environment):
    """A command with two busy workers: the process, and (process id, folder) of each worker."""
    script = tmp_path / "script.py"
    script.write_text(RUN_FOR_LONG)
    command = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=importing_environment,
        start_new_session=True,
    )
    with command:
        marks = [tmp_path / "asleep-1.pid", tmp_path / "busy-1.pid"]
        try:
            assert wait_until(lambda: all(mark.exists() for mark in marks)), command.poll()
            words = [mark.read_text().split() for mark in marks]
            yield command, [(int(process), Path(folder)) for process, folder in words]
        finally:
            command.kill()
            for process in (int(mark.read_text().split()[0]) for mark in marks if mark.exists()):
                # The number may belong to somebody else by now.
                if alive(process) and b"local_workers" in Path(f"/proc/{process}/cmdline").read_bytes():
                    os.kill(process, signal.SIGKILL)


class TestEndOfTheParent:
    def test_a_killed_parent_leaves_no_worker_and_no_folder(self, long_run):
        command, workers = long_run
        assert all(alive(process) and folder.parent.name.startswith(PREFIX) for process, folder in workers)
        command.kill()
        assert wait_until(
            lambda: not any(alive(process) or folder.parent.exists() for process, folder in workers), 60
        )

    def test_ctrl_c_ends_everything_at_once_and_quietly(self, long_run):
        command, workers = long_run
        # As a terminal does: to the whole process group.
        os.killpg(command.pid, signal.SIGINT)
        output, errors = command.communicate(
            timeout=200
        )  # not the ten minutes for which the tasks would go on
        assert output == b""
        assert errors.strip().endswith(b"KeyboardInterrupt")
        assert errors.count(b"Traceback") == 1
        assert not any(alive(process) or folder.parent.exists() for process, folder in workers)


class TestForeignCluster:
    def test_a_killed_worker_costs_one_attempt_and_its_task_goes_to_another(self, cluster, tmp_path):
        tasks = [task("a-1", deaths=1), *(task(f"b-{number}") for number in range(10))]
        with DaskCluster(cluster=cluster.address) as engine:
            assert engine.threads_per_worker is None
            assert wait_until(lambda: engine.workers == 2)
            attempts = list(engine.run(tasks, in_folder(die, tmp_path)))
            assert engine.workers == 1
        outcomes = [(attempt.outcome, attempt.attempt) for attempt in attempts if attempt.task.key == "a-1"]
        assert outcomes == [("lost", 1), ("done", 2)]
        assert len(attempts) == 12

    def test_a_scheduler_that_goes_away_ends_the_run(self, cluster, tmp_path):
        with DaskCluster(cluster=cluster.address) as engine:
            attempts = engine.run([task("a-1", asleep=True), task("b-1")], in_folder(stay_or_kill, tmp_path))
            (tmp_path / "scheduler.pid").write_text(str(cluster.processes[0].pid))
            with pytest.raises(RunError, match="lost the Dask scheduler"):
                list(attempts)

    def test_a_scheduler_without_workers_is_named_after_a_while(
        self, tmp_path, monkeypatch, importing_environment
    ):
        cluster = ForeignCluster(tmp_path, importing_environment, workers=0)
        monkeypatch.setattr(ForeignWorkers, "seconds_without_worker", 0.3)
        try:
            with (
                DaskCluster(cluster=cluster.address) as engine,
                pytest.raises(RunError, match=r"start one with `dask worker tcp://127\.0\.0\.1:"),
            ):
                list(engine.run([task("a-1")], in_folder(total, tmp_path)))
        finally:
            cluster.close()

"""Whose fault a failure is: tasks have budgets, hosts have reputations, and hung workers are found out."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from itertools import islice

import pytest
from arithmetic import fail, find_no_compiler, in_folder, stall_once, task, total, total_unless_poisoned
from foreign_cluster import ForeignCluster

from steadylight.engines import Attempt
from steadylight.engines.dask_cluster import DaskCluster
from steadylight.engines.hosts import Hosts
from steadylight.engines.performing import perform_here
from steadylight.engines.pools import ForeignWorkers
from steadylight.engines.readiness import Readiness
from steadylight.engines.stalls import Stalls
from steadylight.errors import BackendError, RunError, SettingsError, StorageError, TaskFailed
from steadylight.sites import FaultSettings, SiteSettings, TlsSettings


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


class TestHosts:
    def test_three_different_tasks_make_a_bad_host_and_time_forgives(self):
        clock = Clock()
        hosts = Hosts(60.0, clock)
        assert [hosts.failed("a", key) for key in ("t-1", "t-1", "t-2")] == [None, None, None]
        assert hosts.failed("a", "t-3") == 60.0
        assert hosts.avoided("a")
        assert not hosts.avoided("b")
        clock.now = 61.0
        assert not hosts.avoided("a")

    def test_who_fails_again_after_being_forgiven_is_avoided_at_once_and_for_longer(self):
        clock = Clock()
        hosts = Hosts(60.0, clock)
        hosts.failed("a", "t-1", severe=True)
        clock.now = 61.0
        assert hosts.failed("a", "t-2") == 120.0

    def test_a_success_clears_the_record(self):
        hosts = Hosts(60.0, Clock())
        hosts.failed("a", "t-1")
        hosts.failed("a", "t-2")
        hosts.succeeded("a")
        assert hosts.failed("a", "t-3") is None


class TestStalls:
    def complaints(self, beats, settings):
        """Complaints at (time, heartbeat, percent of a core)."""
        clock = Clock()
        stalls = Stalls(settings, clock)
        stalls.note_done("shade", 2.0)
        for clock.now, heartbeat, percent in beats:
            yield stalls.complaint("tcp://a", "shade-1", "shade", heartbeat, percent)

    def test_a_worker_without_heartbeats_hangs(self):
        beats = [(0, 0, 90), (5, 5, 90), (14, 5, 90), (16, 5, 90)]
        said = list(self.complaints(beats, FaultSettings(stalled_after=10)))
        assert said[:3] == ["", "", ""]
        assert said[3] == "it has made no progress for 11 s"

    def test_a_worker_that_only_beats_hangs_and_one_at_work_does_not(self):
        idle = [(t, t, 1.0) for t in range(13)]
        assert any(self.complaints(idle, FaultSettings(stalled_after=10)))
        busy = [(t, t, 90.0) for t in range(100)]
        assert not any(self.complaints(busy, FaultSettings(stalled_after=10)))

    def test_a_task_that_takes_far_longer_than_others_of_its_stage_hangs(self):
        settings = FaultSettings(stalled_after=10, slow_factor=5, slow_after=8)
        busy = [(t, t, 90.0) for t in range(13)]
        said = list(self.complaints(busy, settings))
        assert not any(said[:11])
        assert "more than 10 s" in said[-1]


class TestBudgets:
    def taken(self, attempts=3):
        readiness = Readiness([task("a-1")], attempts)
        (the_task, _) = readiness.take()
        return readiness, the_task

    def test_failures_that_are_not_charged_never_end_the_run(self):
        readiness, one = self.taken()
        for _ in range(10):
            assert readiness.failed(one, {"error": "no library"}, "a", charged=False) is None
            readiness.take()
        assert readiness.failed_on(one) == {"a"}

    def test_a_bad_hosts_failures_are_given_back(self):
        readiness, one = self.taken(attempts=2)
        assert readiness.failed(one, {}, "bad") is None
        readiness.take()
        readiness.excuse("bad")
        assert readiness.failed(one, {}, "good") is None
        readiness.take()
        assert isinstance(readiness.failed(one, {}, "good"), TaskFailed)

    def test_losses_with_others_or_at_the_end_of_the_walltime_are_not_charged(self):
        readiness, one = self.taken()
        for _ in range(10):
            assert readiness.lost(one, "walltime", "a", charged=False) is None
            readiness.take()

    def test_what_does_not_suit_waits_and_keeps_its_place(self):
        readiness = Readiness([task("a-1"), task("a-2")], 3)
        assert readiness.take(lambda each: each.key == "a-2")[0].key == "a-2"
        assert readiness.take(lambda _: False) is None
        assert readiness.take()[0].key == "a-1"
        assert readiness.open == 2

    def test_a_task_that_was_done_late_is_withdrawn_only_while_it_waits(self):
        readiness, one = self.taken()
        assert not readiness.withdraw(one)
        readiness.lost(one, "gone")
        assert readiness.withdraw(one)
        readiness.done(one)
        assert readiness.finished


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (ZeroDivisionError("no light"), "task"),
        (MemoryError(), "host"),
        (ImportError("libcuda.so.1"), "host"),
        (BackendError("no LLVM"), "host"),
        (OSError(28, "No space left on device", "/tmp/scratch"), "host"),
        (OSError(2, "No such file", "/data/scene.xml"), "task"),
        (StorageError("run: no space is left"), "storage"),
        (SettingsError("wrong"), "input"),
    ],
)
def test_errors_show_whose_fault_they_are(error, cause):
    def raise_it(_):
        raise error

    assert perform_here(raise_it, task("a-1"), "worker").result["cause"] == cause


@pytest.fixture
def two_hosts(tmp_path, importing_environment):
    """A scheduler with a worker at each of two addresses of loopback, which count as two hosts."""
    cluster = ForeignCluster(tmp_path, importing_environment, workers=0)
    for number in (1, 2):
        cluster.environment = importing_environment | {"HOST_NAME": f"127.0.0.{number}"}
        cluster.start_worker(number, "--host", f"127.0.0.{number}")
    yield cluster
    cluster.close()


def test_a_host_that_fails_every_task_fast_does_not_fail_the_run(two_hosts, tmp_path):
    tasks = [task(f"a-{number:02d}", seconds=0.1) for number in range(20)]
    with DaskCluster(cluster=two_hosts.address) as engine:
        wait_for_workers(engine, 2)
        attempts = list(
            engine.run(tasks, partial(total_unless_poisoned, folder=tmp_path, poisoned="127.0.0.2"))
        )
    assert {attempt.task.key for attempt in attempts if attempt.outcome == "done"} == {t.key for t in tasks}
    failed = [attempt for attempt in attempts if attempt.outcome == "failed"]
    assert len(failed) == 3, Counter(attempt.worker for attempt in attempts)
    assert len({attempt.task.key for attempt in failed}) == 3
    assert failed[-1].result["host_avoided"] == "127.0.0.2"
    assert failed[-1].result["host_avoided_s"] == 900.0


def test_a_task_that_fails_everywhere_still_ends_the_run(two_hosts, tmp_path):
    seen: list[Attempt] = []
    with DaskCluster(cluster=two_hosts.address) as engine:
        wait_for_workers(engine, 2)
        with pytest.raises(TaskFailed, match="no light"):
            seen.extend(engine.run([task("a-1", failures=9)], in_folder(fail, tmp_path)))


def test_what_every_host_lacks_ends_the_run(two_hosts):
    seen: list[Attempt] = []
    with DaskCluster(cluster=two_hosts.address) as engine:
        wait_for_workers(engine, 2)
        with pytest.raises(TaskFailed, match=r"no LLVM \(3 times\)"):
            seen.extend(islice(engine.run([task("a-1")], find_no_compiler), 20))
    assert [attempt.cause for attempt in seen] == ["host"] * 4
    assert seen[0].result["host_avoided"] == "127.0.0.1"
    assert not any("host_avoided" in attempt.result for attempt in seen[1:])


def wait_for_workers(engine, number):
    end = time.monotonic() + 120
    while engine.workers != number:
        assert time.monotonic() < end, engine.workers
        time.sleep(0.05)


def test_a_local_worker_that_hangs_is_killed_and_its_task_done_by_another(tmp_path):
    site = SiteSettings(faults=FaultSettings(stalled_after=4))
    with DaskCluster(workers=1, site=site) as engine:
        attempts = list(engine.run([task("a-1")], in_folder(stall_once, tmp_path)))
    assert [(attempt.outcome, attempt.cause) for attempt in attempts] == [("lost", "hung"), ("done", "")]
    assert "no progress" in attempts[0].result["error"]


def test_a_worker_that_was_given_up_and_wakes_does_no_harm(tmp_path, importing_environment):
    cluster = ForeignCluster(tmp_path, importing_environment, workers=2)
    site = SiteSettings(faults=FaultSettings(stalled_after=4))
    tasks = [task("a-1"), *(task(f"b-{n:02d}", "a-1", seconds=0.2) for n in range(30))]
    try:
        with DaskCluster(cluster=cluster.address, site=site) as engine:
            wait_for_workers(engine, 2)
            attempts = []
            for attempt in engine.run(tasks, in_folder(stall_once, tmp_path)):
                attempts.append(attempt)
                if attempt.cause == "hung":
                    os.kill(int((tmp_path / "stalled").read_text()), signal.SIGCONT)
    finally:
        cluster.close()
    outcomes = Counter((attempt.outcome, attempt.cause) for attempt in attempts)
    assert outcomes == {("lost", "hung"): 1, ("done", ""): 31}
    assert len({attempt.task.key for attempt in attempts}) == 31
    # It has tasks again.
    assert len({attempt.worker for attempt in attempts if attempt.outcome == "done"}) == 2


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """Two authorities: ours, and another that nobody here trusts."""
    from steadylight.engines.certificates import temporary_security

    folders = [tmp_path_factory.mktemp("tls") / name for name in ("ours", "other")]
    for folder in folders:
        temporary_security(folder)
    return [
        TlsSettings(ca=f / "certificate.pem", certificate=f / "certificate.pem", key=f / "key.pem")
        for f in folders
    ]


@pytest.fixture(scope="module")
def secure_cluster(certificates, tmp_path_factory, importing_environment):
    folder = tmp_path_factory.mktemp("secure")
    cluster = ForeignCluster(folder, importing_environment, 1, *options(certificates[0]), protocol="tls")
    yield cluster
    cluster.close()


class TestCertificates:
    def test_with_certificates_the_work_is_done(self, secure_cluster, certificates, tmp_path):
        with DaskCluster(cluster=secure_cluster.address, site=SiteSettings(tls=certificates[0])) as engine:
            attempts = list(engine.run([task("a-1", value=3)], in_folder(total, tmp_path)))
        assert [attempt.outcome for attempt in attempts] == ["done"]

    @pytest.mark.parametrize("which", ["none", "wrong"])
    def test_a_command_without_or_with_wrong_certificates_is_refused(
        self, secure_cluster, certificates, which, monkeypatch
    ):
        monkeypatch.setattr("steadylight.engines.dask_cluster._SECONDS_TO_CONNECT", 2.0)
        site = SiteSettings() if which == "none" else SiteSettings(tls=certificates[1])
        with pytest.raises(SettingsError, match="certificates"):
            DaskCluster(cluster=secure_cluster.address, site=site)

    @pytest.mark.parametrize("which", ["none", "wrong", "in the clear"])
    def test_a_worker_without_or_with_wrong_certificates_is_refused(
        self, secure_cluster, certificates, which, importing_environment, tmp_path
    ):
        address = secure_cluster.address
        given = options(certificates[1]) if which == "wrong" else ()
        if which == "in the clear":
            address = address.replace("tls://", "tcp://")
        command = [sys.executable, "-m", "dask", "worker", address, "--name", "intruder", "--no-nanny"]
        command += ["--no-dashboard", "--death-timeout", "4", *given]
        done = subprocess.run(
            command,
            env=importing_environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert "Registered to" not in done.stderr
        with DaskCluster(cluster=secure_cluster.address, site=SiteSettings(tls=certificates[0])) as engine:
            assert engine.workers == 1

    def test_private_keys_are_for_their_owner_only(self, certificates):
        assert certificates[0].key.stat().st_mode & 0o077 == 0
        assert certificates[0].key.parent.stat().st_mode & 0o077 == 0


def options(tls):
    """Certificates as options of Dask's own commands."""
    return ("--tls-ca-file", str(tls.ca), "--tls-cert", str(tls.certificate), "--tls-key", str(tls.key))


def test_foreign_workers_are_waited_for_but_not_for_ever():
    assert 0 < ForeignWorkers.seconds_without_worker < 1000
    assert issubclass(TaskFailed, RunError)

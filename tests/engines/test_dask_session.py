"""To whom a session sends a task, and when; the scheduler here is a stand-in that does nothing."""

import json
from types import SimpleNamespace

import pytest
from arithmetic import task

from steadylight.engines import dask_session
from steadylight.engines.dask_session import Session
from steadylight.engines.pools import ForeignWorkers
from steadylight.engines.readiness import Readiness
from steadylight.sites import FaultSettings


class Scheduler:
    """A scheduler with a worker on each of some hosts, and its client."""

    status = "running"

    def __init__(self, *hosts):
        self.scheduler = self
        self.identity = None
        self.hosts = hosts
        self.sent = []

    def sync(self, *_, **__):
        worker = {"nthreads": 1, "last_seen": 0.0, "metrics": {}}
        return {"workers": {host: worker | {"name": f"on-{host}", "host": host} for host in self.hosts}}

    def submit(self, *_, key, workers, **__):
        self.sent.append((key, workers[0]))
        return SimpleNamespace(status="pending", add_done_callback=lambda _: None)

    def subscribe_topic(self, *_):
        pass


class Run:
    """A session, its scheduler and the clock, by hand."""

    def __init__(self, monkeypatch, tasks, *hosts, pool=None):
        self.now = 1000.0
        monkeypatch.setattr(dask_session, "time", SimpleNamespace(monotonic=lambda: self.now))
        self.scheduler = Scheduler(*hosts)
        self.session = Session(
            self.scheduler,
            pool or ForeignWorkers(self.scheduler),
            Readiness(tasks, 3),
            lambda _: {},
            FaultSettings(forgive_after=100.0),
        )
        list(self.session._look_at_workers())

    def send(self):
        """Send what can be sent; (task, host) of each."""
        before = len(self.scheduler.sent)
        self.session._send()
        return [(key.rsplit("-", 2)[0], host) for key, host in self.scheduler.sent[before:]]

    def fails(self, host, cause="host"):
        """The task that a host has now fails there."""
        (key,) = [key for key, flight in self.session._flights.items() if flight.host == host]
        result = {"error": "no LLVM", "cause": cause}
        trial = {"outcome": "failed", "seconds": 0.0, "seconds_cpu": 0.0, "worker": host, "result": result}
        self.session._on_report((0.0, json.dumps(trial | {"key": key})))
        ((_, error),) = self.session._collect(wait=False)
        return error


class GrowingPool(ForeignWorkers):
    may_grow = True


def test_a_task_waits_for_a_better_host_each_time_that_it_has_failed(monkeypatch):
    run = Run(monkeypatch, [task("a-1")], "bad", pool=GrowingPool(None))
    assert run.send() == [("a-1", "bad")]
    for _ in range(3):
        run.fails("bad")
        assert run.send() == []
        run.now += 99
        assert run.send() == []
        run.now += 2
        assert run.send() == [("a-1", "bad")]


def test_an_idle_worker_on_a_bad_host_costs_no_look_through_the_tasks(monkeypatch):
    run = Run(monkeypatch, [task(f"a-{n}") for n in range(9)], "bad", "good")
    assert run.send() == [("a-0", "bad"), ("a-1", "good")]
    run.fails("bad")
    asked = []
    monkeypatch.setattr(run.session, "_suits", lambda _, address: asked.append(address))
    assert run.send() == []
    assert asked == []


@pytest.mark.parametrize("hosts", ["ab", "abc"])
def test_what_every_host_lacks_is_charged_to_the_task_once_no_good_host_is_left(monkeypatch, hosts):
    run = Run(monkeypatch, [task("a-1")], *hosts)
    went = []
    error = None
    while error is None:
        ((_, host),) = run.send()
        went.append(host)
        assert len(went) < 20, went
        error = run.fails(host)
    assert str(error) == "task a-1 failed: no LLVM (3 times)"
    assert "".join(went) == hosts[:-1] + 3 * hosts[-1]

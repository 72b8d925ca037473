"""To whom a dispatcher sends a task, and when; the scheduler here is a stand-in that does nothing."""

import json
import weakref
from collections import deque
from types import SimpleNamespace

import pytest
from arithmetic import task

from steadylight.engines import dispatcher
from steadylight.engines.dispatcher import Dispatcher
from steadylight.engines.pools import ForeignWorkers
from steadylight.engines.readiness import Readiness
from steadylight.errors import RunError
from steadylight.sites import FaultSettings


class Future:
    """What becomes of a bundle: an error, once there is one."""

    status = "pending"

    def add_done_callback(self, callback):
        self.settled = callback

    def exception(self, timeout):
        return self.error


class Scheduler:
    """A scheduler with a worker on each of some hosts, and its client."""

    status = "running"

    def __init__(self, *hosts, threads=1):
        self.scheduler = self
        self.threads = threads
        self.identity = None
        self.hosts = hosts
        self.sent = []

    def sync(self, *_, **__):
        worker = {"nthreads": self.threads, "last_seen": 0.0, "metrics": {}}
        return {"workers": {host: worker | {"name": f"on-{host}", "host": host} for host in self.hosts}}

    def submit(self, _work, _perform, bundle, _topic, *, workers, **_):
        self.sent += [(key, workers[0]) for key, _ in bundle]
        return Future()

    def subscribe_topic(self, _topic, handler):
        self.log_event = lambda _topic, words: handler((0.0, words))


class Run:
    """A dispatcher, its scheduler and the clock, by hand."""

    def __init__(self, monkeypatch, tasks, *hosts, pool=None, threads=1):
        self.now = 1000.0
        monkeypatch.setattr(dispatcher, "time", SimpleNamespace(monotonic=lambda: self.now))
        self.scheduler = Scheduler(*hosts, threads=threads)
        self.dispatcher = Dispatcher(
            self.scheduler,
            pool or ForeignWorkers(self.scheduler),
            Readiness(tasks, 3),
            lambda _: {},
            FaultSettings(forgive_after=100.0),
        )
        list(self.dispatcher._look_at_workers())

    def send(self):
        """Send what can be sent; (task, host) of each."""
        before = len(self.scheduler.sent)
        self.dispatcher._send()
        return [(key.rsplit("-", 2)[0], host) for key, host in self.scheduler.sent[before:]]

    def fails(self, host, cause="host"):
        """The task that a host is at fails there."""
        return self.reports(host, "failed", 0.0, {"error": "no LLVM", "cause": cause})

    def does(self, host, seconds, count=1):
        """The next tasks that a host has are done there, each in so many seconds."""
        for _ in range(count):
            self.reports(host, "done", seconds, {})

    def reports(self, host, outcome, seconds, result):
        """A host tells of the task that it is at; the error that ends the run, if any."""
        self.tells(host, outcome, seconds, result)
        ((_, error),) = self.dispatcher._collect(wait=False)
        return error

    def at(self, host):
        """Key of what a host is at."""
        return next(key for key, flight in self.dispatcher._flights.items() if flight.host == host)

    def tells(self, host, outcome, seconds, result, key=None):
        key = key or self.at(host)
        trial = {"outcome": outcome, "seconds": seconds, "seconds_cpu": 0.0, "worker": host, "result": result}
        self.dispatcher._on_report((0.0, json.dumps(trial | {"key": key})))

    def settles(self, host, error=None):
        """The bundle that a host is at ends; what is told of it, as (task, outcome, error)."""
        future = next(flight.future for flight in self.dispatcher._flights.values() if flight.host == host)
        future.status, future.error = "error" if error else "finished", error
        future.settled(future)
        return [(told.task.key, told.outcome, told.cause) for told, _ in self.dispatcher._collect(wait=False)]


class GrowingPool(ForeignWorkers):
    may_grow = True
    grows = True


class PoolThatMayGrow(ForeignWorkers):
    """Another worker would come if there were more to do."""

    may_grow = True


def test_a_task_goes_back_to_the_only_host_at_once_if_no_other_is_on_its_way(monkeypatch):
    run = Run(monkeypatch, [task("a-1")], "only", pool=PoolThatMayGrow(None))
    for _ in range(3):
        assert run.send() == [("a-1", "only")]
        run.fails("only")


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


def test_a_hung_worker_that_cannot_be_restarted_gets_no_task_before_it_reports(monkeypatch):
    run = Run(monkeypatch, [task(f"a-{number}") for number in range(4)], "hung", "good")
    sent = dict(reversed(pair) for pair in run.send())
    key = run.at("hung")
    complaints = iter([[("hung", "no progress")]])
    monkeypatch.setattr(run.dispatcher, "_complaints", lambda _: next(complaints, []))
    lost = []
    for _ in range(3):
        run.now += 10
        lost += [(told.task.key, told.cause) for told, _ in run.dispatcher._look_at_workers()]
        assert "hung" not in {host for _, host in run.send()}
    assert lost == [(sent["hung"], "hung")]
    run.tells("hung", "done", 0.5, {}, key)
    list(run.dispatcher._collect(wait=False))
    run.now += 10
    list(run.dispatcher._look_at_workers())
    assert "hung" in {host for _, host in run.send()}


def test_an_idle_worker_on_a_bad_host_costs_no_look_through_the_tasks(monkeypatch):
    run = Run(monkeypatch, [task(f"a-{n}") for n in range(9)], "bad", "good")
    assert run.send() == [("a-0", "bad"), ("a-1", "good")]
    run.fails("bad")
    asked = []
    monkeypatch.setattr(run.dispatcher, "_suits", lambda _, address: asked.append(address))
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


def many(count):
    return [task(f"a-{number:03d}") for number in range(count)]


class TestBundles:
    def test_the_first_tasks_go_one_by_one_and_then_so_many_that_they_last_two_seconds(self, monkeypatch):
        run = Run(monkeypatch, many(40), "one")
        assert run.send() == [("a-000", "one")]
        run.does("one", seconds=0.5)
        assert run.send() == [(f"a-{number:03d}", "one") for number in range(1, 5)]

    def test_the_next_bundle_waits_behind_the_last_short_task_only(self, monkeypatch):
        run = Run(monkeypatch, many(40), "one")
        run.send()
        run.does("one", seconds=0.5)
        assert len(run.send()) == 4
        run.does("one", seconds=0.5, count=2)
        assert run.send() == []
        run.does("one", seconds=0.5)
        assert len(run.send()) == 4
        run.does("one", seconds=0.5, count=4)
        for _ in range(9):
            run.dispatcher._paces.note("a", 2.5)
        assert run.send() == []
        run.does("one", seconds=2.5)
        assert len(run.send()) == 1

    def test_a_worker_of_several_threads_gets_a_bundle_when_it_has_done_the_one_before(self, monkeypatch):
        run = Run(monkeypatch, many(40), "one", threads=4)
        run.send()
        run.does("one", seconds=0.5)
        assert len(run.send()) == 4
        run.does("one", seconds=0.5, count=3)
        assert run.send() == []
        run.does("one", seconds=0.5)
        assert len(run.send()) == 4

    def test_a_bundle_is_no_longer_than_the_time_that_a_worker_has_left(self, monkeypatch):
        class Ending(ForeignWorkers):
            def has_time(self, name, seconds):
                return seconds <= 1.2

        run = Run(monkeypatch, many(40), "one", pool=Ending(None))
        run.send()
        run.does("one", seconds=0.5)
        assert len(run.send()) == 2

    def test_a_host_where_a_task_failed_gets_one_at_a_time_until_one_is_done(self, monkeypatch):
        run = Run(monkeypatch, many(100), "a", "b")
        run.send()
        run.does("a", seconds=0.5)
        run.does("b", seconds=0.5)
        assert len(run.send()) == 8
        run.does("a", seconds=0.5, count=3)
        run.fails("a", cause="task")
        assert [host for _, host in run.send()] == ["a"]
        run.does("a", seconds=0.5)
        assert [host for _, host in run.send()] == 4 * ["a"]

    def test_what_fails_in_a_bundle_after_its_host_turned_bad_is_not_charged(self, monkeypatch):
        run = Run(monkeypatch, many(100), "a", "b")
        run.send()
        run.does("a", seconds=0.2)
        run.does("b", seconds=0.2)
        bundle = [key for key, host in run.send() if host == "a"]
        assert len(bundle) == 10
        for _ in bundle:
            run.fails("a", cause="task")
        assert run.dispatcher._hosts.avoided("a")
        assert all(not failures.total() for failures in run.dispatcher._readiness._failures.values())

    def test_a_bundle_that_cannot_be_read_is_charged_to_its_first_task_and_the_others_go_back(
        self, monkeypatch
    ):
        run = Run(monkeypatch, many(40), "one")
        run.send()
        run.does("one", seconds=0.5)
        assert len(run.send()) == 4
        assert run.settles("one", AttributeError("no such function")) == [("a-001", "failed", "task")]
        readiness = run.dispatcher._readiness
        assert [readiness._tries[f"a-{number:03d}"] for number in range(1, 5)] == [1, 0, 0, 0]
        assert run.dispatcher._queues["one"] == deque()
        assert run.send()[0] == ("a-001", "one")

    def test_reports_of_a_worker_that_is_gone_are_heard_before_a_task_is_counted_as_lost(self, monkeypatch):
        run = Run(monkeypatch, many(40), "one")
        run.send()
        run.does("one", seconds=0.5)
        assert len(run.send()) == 4
        future = next(iter(run.dispatcher._flights.values())).future
        future.settled(future)
        heard = run.scheduler.log_event

        def late(topic, words):  # the last report is on its way while the worker is already gone
            run.tells("one", "done", 0.5, {})
            heard(topic, words)

        run.scheduler.log_event = late
        run.scheduler.hosts = ()
        run.now += 10
        ended = [(told.task.key, told.outcome) for told, _ in run.dispatcher._look_at_workers()]
        assert ended == [("a-001", "done"), ("a-002", "lost")]

    def test_a_bundle_whose_tasks_have_all_reported_ends_without_a_word(self, monkeypatch):
        run = Run(monkeypatch, many(40), "one")
        run.send()
        flight = next(iter(run.dispatcher._flights.values()))
        run.does("one", seconds=0.5)
        flight.future.settled(flight.future)
        assert list(run.dispatcher._collect(wait=False)) == []

    def test_a_scheduler_forgets_a_bundle_only_after_its_last_task(self, monkeypatch):
        run = Run(monkeypatch, many(40), "one")
        run.send()
        run.does("one", seconds=0.5)
        run.send()
        future = weakref.ref(next(iter(run.dispatcher._flights.values())).future)
        run.does("one", seconds=0.5, count=3)
        assert future() is not None
        run.does("one", seconds=0.5)
        assert future() is None


def die_at_once(run, *hosts):
    """All these workers are gone at the next look, and others come in their place; the errors that end the run."""
    run.send()
    run.scheduler.hosts = ()
    run.now += 100
    errors = [error for _, error in run.dispatcher._look_at_workers() if error is not None]
    run.scheduler.hosts = hosts
    run.now += 100
    list(run.dispatcher._look_at_workers())
    return errors


def test_workers_that_keep_dying_together_end_the_run_with_a_word_about_memory(monkeypatch):
    run = Run(monkeypatch, [task("a-1"), task("a-2")], "one", "two")
    for _ in range(3):
        assert die_at_once(run, "one", "two") == []
    (error,) = die_at_once(run, "one", "two")
    assert isinstance(error, RunError)
    assert "died at the same time, 4 times without finishing a task in between" in str(error)
    assert "too little memory" in str(error)


def test_workers_that_die_together_now_and_then_end_nothing(monkeypatch):
    run = Run(monkeypatch, [task(f"a-{number}") for number in range(9)], "one", "two")
    for _ in range(5):
        assert die_at_once(run, "one", "two") == []
        run.send()
        run.does("one", 1.0)

"""Fixtures of the whole suite, and `--slow`."""

from __future__ import annotations

import gc
import os
import signal
import sys

import pytest

from small_film import write_film
from steadylight.llvm import find_llvm

os.environ.setdefault("MPLBACKEND", "Agg")
find_llvm()  # before any test imports Mitsuba, in whatever order they run


@pytest.fixture
def steady(monkeypatch, capsys):
    """Give a command; returns its exit code, its output and its errors."""
    from steadylight import cli

    monkeypatch.setattr("signal.signal", lambda *_: None)

    def give(*arguments):
        monkeypatch.setattr(sys, "argv", ["steadylight", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        said = capsys.readouterr()
        assert "Traceback" not in said.err or "--debug" in arguments
        return end.value.code, said.out, said.err

    return give


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory with a scene and a camera file."""
    monkeypatch.chdir(tmp_path)
    write_film(tmp_path)
    return tmp_path


@pytest.fixture
def said(steady, folder):
    """Give a command in that directory; returns its exit code and all that it said, in one line."""

    def give(*arguments):
        code, out, err = steady(*arguments)
        return code, " ".join((out + err).split())

    return give


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run tests that take long")


SERVERS = ("tests/animation", "tests/engines", "tests/grid")
"""Folders whose tests start servers and watch clocks: in a run of several processes, one of them has these."""
WITH_CACHES = "tests/scenes"
"""A folder whose modules keep in functions what takes time to make."""
RENDERING = ("tests/renderers", "tests/physics", "tests/test_byte_equality")
"""Where most of the time goes."""
BATCH_SYSTEMS = ("slurm", "sge")
"""Each takes seconds to start, and one process has all tests with it."""


def pytest_collection_finish():
    # Each scene that is built collects garbage first: not what was imported, again and again.
    gc.collect()
    gc.freeze()


def pytest_configure():
    # What a shell starts in the background ignores Ctrl-C, and so would the commands under test.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def shares_a_fixture(item):
    """Whether the tests of a module have something in common that takes time to make."""
    definitions = (each[-1] for each in item._fixtureinfo.name2fixturedefs.values())
    return any(definition.scope in {"module", "class"} for definition in definitions)


def group_of(item):
    """Name of the tests that one process has together with this one; None if any process may have it.

    What tests share is made once, and kernels are compiled once, where one process has all of a module.
    """
    parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
    for name in BATCH_SYSTEMS:
        if name in item.fixturenames or name in parameters:
            return name
    if item.nodeid.startswith(SERVERS):
        return "servers"
    module = item.nodeid.split("::")[0]
    return module if shares_a_fixture(item) or module.startswith(WITH_CACHES) else None


@pytest.hookimpl(trylast=True)  # after they were shuffled
def pytest_collection_modifyitems(config, items):
    # What takes longest is begun first, so that at the end no process waits for another.
    items.sort(key=lambda item: (not item.nodeid.startswith(SERVERS), not item.nodeid.startswith(RENDERING)))
    for item in items:
        if group := group_of(item):
            item.add_marker(pytest.mark.xdist_group(group))
    if config.getoption("--slow"):
        return
    skip = pytest.mark.skip(reason="takes long; run with --slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)

"""Fixtures of the whole suite, and `--slow`."""

from __future__ import annotations

import os
import signal

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run tests that take more than a minute")


SERVERS = ("tests/animation", "tests/engines", "tests/grid")
"""Folders whose tests start servers and watch clocks: in a run of several processes, one of them has these."""


def pytest_configure():
    # What a shell starts in the background ignores Ctrl-C, and so would the commands under test.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config, items):
    for item in items:
        if item.nodeid.startswith(SERVERS):
            item.add_marker(pytest.mark.xdist_group("servers"))
    if config.getoption("--slow"):
        return
    skip = pytest.mark.skip(reason="takes more than a minute; run with --slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)

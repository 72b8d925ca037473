"""Engines to run the same tests on."""

import os
import sys

import pytest
from foreign_cluster import ForeignCluster

from steadylight.engines.dask_cluster import DaskCluster
from steadylight.engines.in_process import InProcess


@pytest.fixture(scope="session")
def importing_environment():
    """Environment of a process that finds the modules that this one finds."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


@pytest.fixture(scope="module")  # idle, it takes an eighth of a core
def foreign_cluster(tmp_path_factory, importing_environment):
    cluster = ForeignCluster(tmp_path_factory.mktemp("foreign"), importing_environment, workers=2)
    yield cluster
    cluster.close()


@pytest.fixture
def cluster(request, tmp_path, importing_environment):
    """A foreign cluster that the test may hurt: two workers, or as many as its indirect parameter says."""
    made = ForeignCluster(tmp_path, importing_environment, workers=getattr(request, "param", 2))
    yield made
    made.close()


@pytest.fixture(scope="module", params=["in-process", "one worker", "two workers", "address"])
def engine(request):
    """Every engine, with an attempt limit of 3."""
    if request.param == "in-process":
        made = InProcess(attempts=3)
    elif request.param == "address":
        made = DaskCluster(cluster=request.getfixturevalue("foreign_cluster").address, attempts=3)
    else:
        made = DaskCluster(workers=1 if request.param == "one worker" else 2, attempts=3)
    with made:
        yield made

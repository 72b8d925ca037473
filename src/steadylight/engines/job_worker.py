"""What a batch job runs: Dask's worker, in a private scratch folder and reachable on one network interface only.

`python -m steadylight.engines.job_worker SCHEDULER OPTION...` takes the options of `dask worker`. By default, Dask
would listen on all interfaces of the node, run an HTTP server, and use a scratch folder with a fixed name, which
another user of the node may have prepared.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from steadylight.engines.private_folder import PrivateFolder


def main(arguments: list[str]) -> None:
    """Serve until the scheduler is gone or the job ends.

    Args:
        arguments: address of the scheduler, then options of `dask worker`.
    """
    import dask
    from distributed.cli.dask_worker import main as dask_worker

    ours = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    ours.add_argument("--local-directory")
    known, rest = ours.parse_known_args(arguments)
    parent = None if known.local_directory is None else Path(os.path.expandvars(known.local_directory))
    if parent is not None:
        parent.mkdir(parents=True, exist_ok=True)
    scratch = PrivateFolder(parent)
    try:
        dask.config.set({"distributed.worker.http.routes": []})
        dask_worker([*rest, *_place(rest), "--local-directory", str(scratch.path)])
    finally:
        scratch.remove()


def _place(options: list[str]) -> list[str]:
    """Options that bind the worker to the interface on which it reaches the scheduler, unless others are given."""
    from distributed.comm import get_address_host
    from distributed.utils import get_ip

    given = {option.partition("=")[0] for option in options}
    place = [] if "--dashboard-address" in given else ["--dashboard-address", "127.0.0.1:0"]
    if not given & {"--host", "--interface", "--listen-address"}:
        place += ["--host", get_ip(get_address_host(options[0]))]
    return place


if __name__ == "__main__":
    main(sys.argv[1:])

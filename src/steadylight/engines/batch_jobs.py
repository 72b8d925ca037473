"""Workers as jobs of a batch system: the job script (written by dask-jobqueue), and the status of jobs."""

from __future__ import annotations

import getpass
import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import dask

from steadylight.errors import SettingsError
from steadylight.sites import BATCH_SYSTEMS, walltime_seconds

if TYPE_CHECKING:
    from collections.abc import Iterable

    from distributed.security import Security

    from steadylight.sites import BatchSystem, SiteSettings

_SECONDS_TO_LIST = 30.0
_USER: Final = "{user}"
_PLAIN_PATH: Final = re.compile(r"[\w./+,:@=~-]+")
"""Paths that need no quoting in the head of a job script, on any batch system."""


@dataclass(frozen=True)
class _System:
    """Properties of a batch system.

    Attributes:
        module: module of dask-jobqueue.
        job: class in that module.
        submit: command that submits jobs.
        listing: command that prints a line for each of the user's waiting or running jobs, starting with its id.
        empty: message on standard error if there are no jobs, where that counts as a failure.
        account: name of the account option in dask-jobqueue.
        directives: lines for every job. They disable automatic requeueing, because lost jobs are replaced here.
        silence: lines that discard what the system writes about a job.
        hours_first: whether a walltime of two parts is `HH:MM`; otherwise it is `MM:SS`.
    """

    module: str
    job: str
    submit: str
    listing: tuple[str, ...]
    empty: str = "no unfinished job"
    account: str = "project"
    directives: tuple[str, ...] = ()
    silence: tuple[str, ...] = ("-o /dev/null", "-e /dev/null")
    hours_first: bool = False


_SYSTEMS: Final[dict[str, _System]] = {
    "slurm": _System(
        "slurm",
        "SLURMJob",
        "sbatch",
        ("squeue", "--noheader", "--me", "--format=%A"),
        account="account",
        directives=("--no-requeue",),
    ),
    "sge": _System("sge", "SGEJob", "qsub", ("qstat", "-u", _USER), directives=("-S /bin/bash", "-r n")),
    "pbs": _System("pbs", "PBSJob", "qsub", ("qstat", "-u", _USER), account="account", directives=("-r n",)),
    "lsf": _System(
        "lsf", "LSFJob", "bsub", ("bjobs", "-noheader", "-o", "jobid"), directives=("-rn",), hours_first=True
    ),
    "htcondor": _System(
        "htcondor",
        "HTCondorJob",
        "condor_submit",
        ("condor_q", _USER, "-format", "%d.", "ClusterId", "-format", "%d\n", "ProcId"),
        account="account",
    ),
    "oar": _System(
        "oar",
        "OARJob",
        "oarsub",
        ("oarstat", "-u", _USER),
        silence=("-O /dev/null", "-E /dev/null"),
        hours_first=True,
    ),
}
assert tuple(_SYSTEMS) == BATCH_SYSTEMS


def check_batch_system(system: BatchSystem, site: SiteSettings) -> None:
    """Check whether jobs can be submitted from here, as far as possible without submitting one.

    Raises:
        SettingsError: the commands are missing, or the site settings lack something that the system needs.
    """
    command = _SYSTEMS[system].submit
    if shutil.which(command) is None:
        raise SettingsError(
            f"--cluster {system}: command {command} not found; run steadylight on a machine that can submit "
            "jobs, or give the address of a Dask scheduler"
        )
    make_job(system, site, Scheduler("tcp://address:0"), name="check")


def cores_of(system: BatchSystem, site: SiteSettings) -> int:
    """Cores of a job, from the site settings or Dask's configuration."""
    return int(site.cores or dask.config.get(f"jobqueue.{system}.cores"))


def walltime_of(system: BatchSystem, site: SiteSettings) -> float:
    """Time limit of a job in seconds, from the site settings or Dask's configuration; infinite if neither has one."""
    text = site.walltime or dask.config.get(f"jobqueue.{system}.walltime", None)
    if text is None:
        return float("inf")
    return walltime_seconds(str(text), hours_first=_SYSTEMS[system].hours_first)


@dataclass(frozen=True)
class Scheduler:
    """The scheduler with which workers register.

    Attributes:
        address: address of the scheduler.
        security: certificates as file paths; None without TLS.
    """

    address: str
    security: Security | None = None


def make_job(
    system: BatchSystem,
    site: SiteSettings,
    scheduler: Scheduler,
    *,
    name: str,
    folder: Path | None = None,
    marker: Path | None = None,
) -> Any:
    """Make a dask-jobqueue job without submitting it: one worker process whose cores are left to the renderer.

    Args:
        system: the batch system.
        site: settings of the site's jobs.
        scheduler: where the worker registers.
        name: name of the worker.
        folder: for job logs, on a file system shared with the nodes; no logs if None.
        marker: if this file no longer exists when the job starts, the job is no longer wanted and exits.

    Raises:
        SettingsError: the settings lack something that the system needs, or contain something it does not support; or
            a path has a character that cannot be written into a job script.
    """
    kind = _SYSTEMS[system]
    redirected = folder is not None and not _PLAIN_PATH.fullmatch(str(folder))
    for path in (folder, marker, Path(sys.executable), *_files_of(scheduler.security).values()):
        _check_path(system, path)
    options: dict[str, Any] = {
        "scheduler": scheduler.address,
        "name": name,
        "job_name": site.job_name,
        "cores": site.cores,
        "memory": site.memory,
        "walltime": site.walltime,
        "queue": site.queue,
        kind.account: site.account,
        "resource_spec": site.resources,
        "disk": site.disk,
        "processes": 1,
        "nanny": True,
        "python": site.python or shlex.quote(sys.executable),
        "interface": site.interface,
        "local_directory": None if site.scratch is None else shlex.quote(site.scratch),
        "log_directory": None if folder is None or redirected else str(folder),
        "death_timeout": round(site.start_within),
        "worker_command": "steadylight.engines.job_worker",
        "worker_extra_args": [*_worker_options(system), *_certificate_options(scheduler.security)],
        "job_script_prologue": [
            *(_redirection(folder, name) if folder is not None and redirected else []),
            *_prologue(system, site, marker),
        ],
        "job_directives_skip": site.skip_directives or None,
        "job_extra_directives": _directives(system, site, quiet=redirected),
    }
    options = {key: value for key, value in options.items() if value is not None}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = importlib.import_module(f"dask_jobqueue.{kind.module}")
        try:
            return getattr(module, kind.job)(**options)
        except (TypeError, ValueError) as error:
            raise SettingsError(_what_is_missing(system, site, error)) from error


def listed_jobs(system: BatchSystem) -> set[str] | None:
    """Ids of the user's waiting and running jobs; None if the system does not answer."""
    kind = _SYSTEMS[system]
    command = [word.replace(_USER, getpass.getuser()) for word in kind.listing]
    try:
        done = subprocess.run(  # noqa: S603 - the command is ours
            command, capture_output=True, text=True, check=False, timeout=_SECONDS_TO_LIST
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode != 0 and kind.empty not in done.stderr.lower():
        return None
    return {line.split()[0] for line in done.stdout.splitlines() if line.strip()}


def is_listed(job_id: str, listed: Iterable[str]) -> bool:
    """Whether a job is in a listing; some systems append the server name to the number."""
    return any(word == job_id or word.startswith(f"{job_id}.") for word in listed)


def last_words(folder: Path, job_id: str, worker: str = "") -> str:
    """The end of a job's output, as far as it is available; `worker` is the name of its worker."""
    # NAME-17.err, NAME.e17, NAME.pe17 or 17.SERVER.ER: not 117, nor the 17 in the name of a worker.
    number = re.escape(job_id.split(".", maxsplit=1)[0])
    name = re.compile(rf"(^|[-.])(p?[eo])?{number}(\.|$)")
    own = f"{worker}.out"  # see `_redirection`
    logs = [p for p in folder.glob("*") if (name.search(p.name) or p.name == own) and p.is_file()]
    texts = [path.read_bytes()[-1000:].decode(errors="replace").strip() for path in sorted(logs)]
    return "\n".join(text for text in texts if text)


def _worker_options(system: str) -> list[str]:
    # A worker does one task at a time, so its pool has one thread. Of repeated options, the last one counts. Dask gets
    # no memory limit: it would count mapped files as the worker's memory, and the batch system enforces a limit anyway.
    ours = ["--nanny", "--nthreads", "1", "--memory-limit", "0", "--no-dashboard"]
    return [*dask.config.get(f"jobqueue.{system}.worker-extra-args", []), *ours]


def _files_of(security: Security | None) -> dict[str, Path]:
    """Certificate files of a worker, by option."""
    files = {} if security is None else security.get_tls_config_for_role("worker")
    return {
        f"--tls-{name.replace('_', '-')}": Path(path) for name, path in files.items() if name != "ciphers"
    }


def _certificate_options(security: Security | None) -> list[str]:
    # Added here rather than by dask-jobqueue, which does not quote paths.
    options = [word for name, path in _files_of(security).items() for word in (name, shlex.quote(str(path)))]
    return options if security is None else ["--protocol", "tls://", *options]


def _check_path(system: str, path: Path | None) -> None:
    """Refuse paths that cannot be quoted for the batch system.

    Raises:
        SettingsError: a character of the path is not supported.
    """
    # Systems look for directives at the start of every line. HTCondor expands macros even within quotes.
    for character in str(path or ""):
        if not character.isprintable() or (system == "htcondor" and character in "$%"):
            raise SettingsError(
                f"--cluster {system}: {str(path)!r}: the character {character!r} cannot be written into a job "
                "script; choose a path without it"
            )


def _redirection(folder: Path, name: str) -> list[str]:
    """Shell line that redirects the output of a job, for a folder that the head of the script cannot name."""
    return [f"exec > {shlex.quote(str(folder / name))}.out 2>&1"]


def _prologue(system: str, site: SiteSettings, marker: Path | None) -> list[str]:
    lines = list(site.prologue) or list(dask.config.get(f"jobqueue.{system}.job-script-prologue", []))
    if site.python is None and "PYTHONPATH" in os.environ:
        # The same Python must find the same modules.
        path = os.pathsep.join(
            str(Path(part).resolve()) for part in os.environ["PYTHONPATH"].split(os.pathsep)
        )
        lines.insert(0, f"export PYTHONPATH={shlex.quote(path)}")
    if marker is not None:
        lines.insert(0, f"[ -e {shlex.quote(str(marker))} ] || exit 0")
    return lines


def _directives(system: str, site: SiteSettings, *, quiet: bool) -> list[str] | dict[str, str]:
    """Lines for the head of the script; `quiet` discards what the system itself writes about the job."""
    theirs = dask.config.get(f"jobqueue.{system}.job-extra-directives", None)
    if system == "htcondor":
        pairs = [line.partition("=") for line in site.directives]
        return {**(theirs or {}), **{name.strip(): value.strip() for name, _, value in pairs}}
    silence = _SYSTEMS[system].silence if quiet else ()
    lines = [*_SYSTEMS[system].directives, *silence, *(theirs or []), *site.directives]
    if system == "sge" and site.parallel_environment:
        lines.append(f"-pe {site.parallel_environment} {cores_of('sge', site)}")
    return lines


def _what_is_missing(system: str, site: SiteSettings, error: Exception) -> str:
    """Translate an error of dask-jobqueue into terms of the site file."""
    needed = ["cores", "memory", *(["disk"] if system == "htcondor" else [])]
    missing = [
        key
        for key in needed
        if getattr(site, key) is None and dask.config.get(f"jobqueue.{system}.{key}", None) is None
    ]
    if missing:
        example = {"cores": "cores = 16", "memory": 'memory = "60 GB"', "disk": 'disk = "10 GB"'}
        return (
            f"--cluster {system}: {' and '.join(missing)} of a job must be set; give a --site file with "
            f"{', '.join(f'`{example[key]}`' for key in missing)}, or set jobqueue.{system} in Dask's configuration"
        )
    return f"--cluster {system}: the site settings are not valid for this batch system: {error}"

"""Where a site's batch system puts workers, and how long to bear with them: `--site FILE`.

A site file is TOML. What it leaves out comes from Dask's own configuration (`jobqueue.slurm` and so on), so that
a cluster whose administrators keep one needs no file of ours.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

from steadylight.errors import SettingsError

BatchSystem = Literal["slurm", "sge", "pbs", "lsf", "htcondor", "oar"]
BATCH_SYSTEMS: Final[tuple[BatchSystem, ...]] = ("slurm", "sge", "pbs", "lsf", "htcondor", "oar")
"""What `--cluster` takes besides `local`, `in-process` and an address."""

_MEMORY = re.compile(r"\d+(\.\d+)?\s*[kMGT]i?B", re.IGNORECASE)
_WALLTIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<parts>\d+(?::\d+){0,2})")


def _check_memory(text: str) -> str:
    if not _MEMORY.fullmatch(text.strip()):
        raise ValueError('give a number with its unit, such as "60 GB"')
    return text.strip()


def _check_walltime(text: str) -> str:
    walltime_seconds(text)
    return text


def _check_line(text: str) -> str:
    if "\n" in text:
        raise ValueError("one line for each entry of the list")
    return text


Memory = Annotated[str, AfterValidator(_check_memory)]
Walltime = Annotated[str, AfterValidator(_check_walltime)]
Line = Annotated[str, AfterValidator(_check_line)]


class TlsSettings(BaseModel):
    """Certificates that scheduler, workers and this command show each other; PEM files.

    Attributes:
        ca: certificate of the authority that signed all others; who shows none of its is refused.
        certificate: our own.
        key: the private key to it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    ca: Path
    certificate: Path
    key: Path


class FaultSettings(BaseModel):
    """How long to bear with workers and hosts that misbehave.

    Attributes:
        stalled_after: seconds without a sign of progress (no heartbeat, or no use of the processor) after
            which a worker counts as hung.
        slow_factor: a task may last this many times as long as the longest of its stage ...
        slow_after: ... and at least so many seconds, before its worker counts as hung.
        forgive_after: seconds for which a host where tasks keep failing gets no more of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stalled_after: PositiveFloat = 900.0
    slow_factor: PositiveFloat = 20.0
    slow_after: PositiveFloat = 3600.0
    forgive_after: PositiveFloat = 900.0


class SiteSettings(BaseModel):
    """What a site asks of a job; no effect on any byte of the result.

    Attributes:
        queue: queue or partition.
        account: account or project that pays.
        cores: of a job, which is one worker that uses them all: those of a node.
        memory: of a job, with its unit.
        walltime: longest time of a job, `HH:MM:SS` or `D-HH:MM:SS` (LSF: `HH:MM`).
        disk: scratch space of a job, with its unit (HTCondor).
        resources: the resource specification as the system writes it (Grid Engine, PBS, OAR: after `-l`).
        parallel_environment: the name for `-pe NAME cores` (Grid Engine).
        directives: more lines for the head of the job script, without the `#SBATCH` or the like; for HTCondor
            `name = value`.
        skip_directives: lines of the head that hold one of these are left out.
        prologue: shell lines before the worker starts: modules, environments.
        python: the Python of the nodes; this one if None.
        scratch: folder for a worker's own files, on the node.
        job_name: as the batch system lists them.
        interface: network interface by which nodes and scheduler reach each other.
        host: address at which the nodes reach the machine of this command; overrides `interface` there.
        port: of the scheduler; any free one if 0.
        minimum_workers: jobs that are kept even when there is little to do.
        maximum_workers: jobs at most; `--workers` if None.
        idle_after: seconds without work after which a job above the minimum is given back.
        start_within: seconds that a worker tries to reach the scheduler before its job ends.
        encrypted: TLS between scheduler, workers and this command, with certificates made for this command
            unless `tls` names others.
        tls: certificates to use.
        faults: how long to bear with what misbehaves.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    queue: str | None = None
    account: str | None = None
    cores: PositiveInt | None = None
    memory: Memory | None = None
    walltime: Walltime | None = None
    disk: Memory | None = None
    resources: str | None = None
    parallel_environment: str | None = None
    directives: tuple[Line, ...] = ()
    skip_directives: tuple[str, ...] = ()
    prologue: tuple[Line, ...] = ()
    python: str | None = None
    scratch: str | None = None
    job_name: str = Field(default="steadylight", pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")
    interface: str | None = None
    host: str | None = None
    port: NonNegativeInt = 0
    minimum_workers: NonNegativeInt = 1
    maximum_workers: PositiveInt | None = None
    idle_after: PositiveFloat = 300.0
    start_within: PositiveFloat = 300.0
    encrypted: bool = True
    tls: TlsSettings | None = None
    faults: FaultSettings = FaultSettings()

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if self.maximum_workers is not None and self.minimum_workers > self.maximum_workers:
            raise ValueError("minimum_workers is more than maximum_workers")
        if self.tls is not None and not self.encrypted:
            raise ValueError("tls names certificates, but encrypted is false")
        return self

    @property
    def for_jobs(self) -> list[str]:
        """Names of what was set and has a meaning for batch jobs only."""
        return sorted(self.model_fields_set - {"tls", "faults"})


def load_site(path: Path) -> SiteSettings:
    """Read a site file; paths of certificates are relative to it.

    Raises:
        SettingsError: it cannot be read, or a key or value in it is wrong.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"--site: {path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"--site: {path}: not TOML: {error}") from error
    try:
        site = SiteSettings(**content)
    except ValidationError as error:
        raise SettingsError(_explain(path, error)) from None
    return site if site.tls is None else site.model_copy(update={"tls": _resolve(path, site.tls)})


def walltime_seconds(text: str, *, hours_first: bool = False) -> float:
    """Seconds of `HH:MM:SS`, `D-HH:MM:SS`, a number of minutes, or two parts.

    Args:
        text: as the user wrote it.
        hours_first: whether two parts are `HH:MM`; `MM:SS` otherwise.

    Raises:
        ValueError: none of these.
    """
    match = _WALLTIME.fullmatch(text.strip())
    if match is None:
        raise ValueError("give hours, minutes and seconds, such as 04:00:00")
    parts = [int(part) for part in match["parts"].split(":")]
    days = int(match["days"] or 0) * 86400
    if len(parts) == 1:
        return days + parts[0] * (3600 if days else 60)
    if len(parts) == 2 and not days and not hours_first:
        return parts[0] * 60 + parts[1]
    hours, minutes, seconds = (*parts, 0)[:3]
    return days + hours * 3600 + minutes * 60 + seconds


def _resolve(path: Path, tls: TlsSettings) -> TlsSettings:
    """Certificates relative to the site file, and there.

    Raises:
        SettingsError: one of the files is not there.
    """
    found = {name: path.parent / getattr(tls, name) for name in TlsSettings.model_fields}
    for name, file in found.items():
        if not file.is_file():
            raise SettingsError(f"--site: {path}: tls.{name}: there is no file {file}")
    return TlsSettings(**{name: file.resolve() for name, file in found.items()})


def _explain(path: Path, error: ValidationError) -> str:
    """Pydantic's findings as a line each, with file and key, and the keys that there are."""
    lines = []
    for finding in error.errors():
        key = ".".join(str(part) for part in finding["loc"])
        where = f"--site: {path}: {key}: " if key else f"--site: {path}: "
        if finding["type"] == "extra_forbidden":
            lines.append(f"{where}there is no such key; there are {_keys(finding['loc'])}")
        else:
            reason = finding["msg"].removeprefix("Value error, ")
            given = f"{finding['input']!r} is not valid: " if key else ""
            lines.append(f"{where}{given}{reason[:1].lower()}{reason[1:]}")
    return "\n".join(lines)


def _keys(place: tuple[Any, ...]) -> str:
    tables: dict[Any, type[BaseModel]] = {"tls": TlsSettings, "faults": FaultSettings}
    return ", ".join(tables.get(place[0] if len(place) > 1 else None, SiteSettings).model_fields)

"""Site settings (`--site FILE`): how the batch system runs workers, and how long faulty ones are tolerated.

A site file is TOML. Missing keys come from Dask's own configuration (`jobqueue.slurm` and so on), so that a cluster
whose administrators maintain one needs no site file.
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
"""Values of `--cluster` besides `local`, `in-process` and an address."""

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
        raise ValueError("give one line per list entry")
    return text


Memory = Annotated[str, AfterValidator(_check_memory)]
Walltime = Annotated[str, AfterValidator(_check_walltime)]
Line = Annotated[str, AfterValidator(_check_line)]


class TlsSettings(BaseModel):
    """Certificates for mutual authentication of scheduler, workers and this command; PEM files.

    Attributes:
        ca: certificate of the authority that signed all others; peers without such a certificate are rejected.
        certificate: certificate of this command.
        key: private key of `certificate`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    ca: Path
    certificate: Path
    key: Path


class FaultSettings(BaseModel):
    """How long faulty workers and hosts are tolerated.

    Attributes:
        stalled_after: seconds without progress (no heartbeat, or no CPU use) after which a worker counts as
            hung.
        slow_factor: a worker counts as hung when its task takes this many times as long as the longest of the
            same stage ...
        slow_after: ... and at least this many seconds.
        forgive_after: seconds for which a host where tasks keep failing is given no more tasks.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stalled_after: PositiveFloat = 900.0
    slow_factor: PositiveFloat = 20.0
    slow_after: PositiveFloat = 3600.0
    forgive_after: PositiveFloat = 900.0


class SiteSettings(BaseModel):
    """Settings of a site's batch jobs; they do not affect the result.

    Attributes:
        queue: queue or partition.
        account: account or project to charge.
        cores: cores of a job, usually those of a node. A job is one worker that uses all of them.
        memory: memory of a job, with its unit.
        walltime: time limit of a job, `HH:MM:SS` or `D-HH:MM:SS` (LSF: `HH:MM`).
        disk: scratch space of a job, with its unit (HTCondor).
        resources: the resource specification in the system's own syntax (Grid Engine, PBS, OAR: after `-l`).
        parallel_environment: the name for `-pe NAME cores` (Grid Engine).
        directives: further directives of the job script, without the `#SBATCH` or similar prefix; for HTCondor
            `name = value`.
        skip_directives: directives that contain one of these strings are omitted.
        prologue: shell lines before the worker starts: modules, environments.
        python: the Python of the nodes; this one if None.
        scratch: folder for a worker's own files, on the node.
        job_name: name of the jobs in the batch system.
        interface: network interface through which nodes and scheduler reach each other.
        host: address at which the nodes reach the machine of this command; overrides `interface` there.
        port: port of the scheduler; any free one if 0.
        minimum_workers: number of jobs to keep even when there is little work.
        maximum_workers: maximum number of jobs; `--workers` if None.
        idle_after: seconds without work after which a job above the minimum is released.
        start_within: seconds for which a worker tries to reach the scheduler before its job ends.
        encrypted: TLS between scheduler, workers and this command, with certificates made for this command
            unless `tls` gives others.
        tls: certificates to use.
        faults: how long faulty workers and hosts are tolerated.
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
    port: int = Field(default=0, ge=0, le=65535)
    minimum_workers: NonNegativeInt = 1
    maximum_workers: PositiveInt | None = None
    idle_after: PositiveFloat = 300.0
    start_within: PositiveFloat = Field(default=300.0, allow_inf_nan=False)
    encrypted: bool = True
    tls: TlsSettings | None = None
    faults: FaultSettings = FaultSettings()

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if self.maximum_workers is not None and self.minimum_workers > self.maximum_workers:
            raise ValueError("minimum_workers is more than maximum_workers")
        if self.tls is not None and not self.encrypted:
            raise ValueError("tls gives certificates, but encrypted is false")
        return self

    @property
    def for_jobs(self) -> list[str]:
        """Names of given settings that apply to batch jobs only."""
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
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SettingsError(f"--site: {path}: not TOML: {error}") from error
    try:
        site = SiteSettings(**content)
    except ValidationError as error:
        raise SettingsError(_explain(path, error)) from None
    return site if site.tls is None else site.model_copy(update={"tls": _resolve(path, site.tls)})


def walltime_seconds(text: str, *, hours_first: bool = False) -> float:
    """Seconds of `HH:MM:SS`, `D-HH:MM:SS`, a number of minutes, or two parts.

    Args:
        text: the user's text.
        hours_first: whether two parts are `HH:MM`; `MM:SS` otherwise.

    Raises:
        ValueError: the text has none of these forms.
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
    """Resolve certificates relative to the site file and check that they exist.

    Raises:
        SettingsError: one of the files does not exist.
    """
    found = {name: path.parent / getattr(tls, name) for name in TlsSettings.model_fields}
    for name, file in found.items():
        if not file.is_file():
            raise SettingsError(f"--site: {path}: tls.{name}: no such file {file}")
    return TlsSettings(**{name: file.resolve() for name, file in found.items()})


def _explain(path: Path, error: ValidationError) -> str:
    """Pydantic's errors, one line each, with file and key; for unknown keys also the valid ones."""
    lines = []
    for finding in error.errors():
        key = ".".join(str(part) for part in finding["loc"])
        where = f"--site: {path}: {key}: " if key else f"--site: {path}: "
        if finding["type"] == "extra_forbidden":
            lines.append(f"{where}unknown key; valid: {_keys(finding['loc'])}")
        else:
            reason = finding["msg"].removeprefix("Value error, ")
            given = f"{finding['input']!r} is not valid; " if key else ""
            lines.append(f"{where}{given}{reason[:1].lower()}{reason[1:]}")
    return "\n".join(lines)


def _keys(place: tuple[Any, ...]) -> str:
    tables: dict[Any, type[BaseModel]] = {"tls": TlsSettings, "faults": FaultSettings}
    return ", ".join(tables.get(place[0] if len(place) > 1 else None, SiteSettings).model_fields)

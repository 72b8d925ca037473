"""Where the work runs: real machines, and simulated ones. Neither affects the result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, SkipValidation

from steadylight.settings.option import IMAGE, MACHINE, SIMULATION, CheckedSettings, Option
from steadylight.sites import SiteSettings

Variant = Literal["auto", "llvm", "cuda"]


class MachineSettings(CheckedSettings):
    """Options that say where the work runs and do not affect the result.

    Attributes:
        workers: worker processes. On one machine they share the cores (`dask_cluster`); in a batch job, each uses all.
        cluster: `in-process`, `local`, a batch system, or the address of a Dask scheduler.
        variant: backend of the Mitsuba renderer; auto is cuda if a device is found, otherwise llvm.
        aovs: also write depth, normal and position of each pixel; frames stay the same.
    """

    workers: Annotated[
        PositiveInt,
        Option("Number of worker processes; with a batch system, the maximum number of jobs.", MACHINE, "N"),
    ] = 1
    cluster: Annotated[
        str,
        Option(
            "Where workers run: local, in-process, a batch system (slurm, sge, pbs, lsf, htcondor, oar), or the "
            "address of a Dask scheduler (tcp://..., tls://...).",
            MACHINE,
            "NAME",
        ),
    ] = "local"
    variant: Annotated[Variant, Option("Backend of the Mitsuba renderer.", MACHINE)] = "auto"
    aovs: Annotated[
        bool,
        Option(
            "Also write depth, normal and position for each pixel (aovs/). They can be added to a finished run later.",
            IMAGE,
        ),
    ] = False


class ExecutionSettings(MachineSettings):
    """Where the work runs; no effect on any byte of the result.

    Attributes:
        site: settings of the batch system, and how long faulty workers and hosts are tolerated.
        attempts: number of times a task may fail before the run gives up.
    """

    site: SiteSettings = SiteSettings()
    attempts: PositiveInt = 3


Seconds = Annotated[NonNegativeFloat, Field(allow_inf_nan=False)]
"""A duration."""

Positive = Annotated[PositiveFloat, Field(allow_inf_nan=False)]


class SimulationOptions(CheckedSettings):
    """Options of `steadylight plan` only: the machines on which a run is simulated.

    Attributes:
        simulate: whether to simulate.
        times: run directory to take task times and file sizes from; that of the plan if None.
        nodes: number of nodes.
        queue_wait: mean wait in the queue for a node, seconds.
        start: start-up time of a node, seconds.
        between_failures: mean time between failures of a node, hours.
        bandwidth: bandwidth of the shared store, MB/s.
    """

    simulate: Annotated[
        bool, Option("Simulate the run on many nodes, with measured task times.", SIMULATION)
    ] = False
    times: Annotated[
        SkipValidation[str | Path | None],
        Option("Run to take task times and file sizes from.", SIMULATION, "RUN", "--output"),
    ] = None
    nodes: Annotated[PositiveInt, Option("Number of nodes.", SIMULATION, "N")] = 200
    queue_wait: Annotated[Seconds, Option("Mean wait in the queue for a node, seconds.", SIMULATION, "S")] = (
        60.0
    )
    start: Annotated[Seconds, Option("Start-up time of a node, seconds.", SIMULATION, "S")] = 20.0
    between_failures: Annotated[
        Positive, Option("Mean time between failures of a node, hours.", SIMULATION, "H")
    ] = 1000.0
    bandwidth: Annotated[Positive, Option("Bandwidth of the shared store, MB/s.", SIMULATION, "MB")] = 1000.0

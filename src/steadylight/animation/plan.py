"""The two passes as data: settings in, tasks with their needs and files out; imports no renderer.

```
gather-00012 ─┐         ┌ audit-1-0001 ┐           ┌ audit-2-0001 ┐                    ┌ shade-00001
gather-00031 ─┼─ merge ─┼ audit-1-0002 ┼─ cover-1 ─┼ audit-2-0002 ┼─ cover-2 ─ finish ─┼ shade-00002
gather-00057 ─┘         └ ...          ┘           └ ...          ┘                    └ ...
```

With `--coverage off` the second pass follows the merge at once; modes without a shared cache have second-pass
tasks only. Nothing here depends on how many workers there are: the same settings always give the same tasks,
so that the bytes do not depend on the machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from steadylight.engines import Task
from steadylight.errors import SettingsError
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from steadylight.settings import RenderSettings

STAGES: Final = ("gather", "merge", "audit", "cover", "finish", "shade")
"""Every stage a task may belong to, in the order of the method."""

AUDIT_ROUNDS: Final = 2
"""How often all frames are looked at for points that the cache cannot answer."""

AUDIT_CHUNK: Final = 8
"""Frames of one audit task: fixed, so that the records do not depend on the number of workers."""

SCENE_FILE: Final = "scene.pickle"
"""The scene as the workers read it, relative to the run directory."""


def gathered_cache(frame: int) -> str:
    """The first-pass cache of a selected frame, relative to the run directory."""
    return RunDirectory.cache_name(f"gather_{frame:05d}")


def merged_cache() -> str:
    """The merged cache of all selected frames, relative to the run directory."""
    return RunDirectory.cache_name("merged")


def audit_points(audit_round: int, chunk: int) -> str:
    """The points of one chunk of frames that the cache cannot answer, relative to the run directory."""
    return f"cache/audit_{audit_round}_{chunk:04d}.points"


def covered_cache(audit_round: int) -> str:
    """The whole cache after a round of the audit, relative to the run directory."""
    return RunDirectory.cache_name(f"covered_{audit_round}")


def finished_cache() -> str:
    """The cache as the second pass reads it, its noise smoothed, relative to the run directory."""
    return RunDirectory.cache_name("finished")


def selected_count(frames: int, choice: int | Literal["auto", "workers"], workers: int) -> int:
    """How many frames the first pass visits.

    Args:
        frames: number of frames of the film.
        choice: a number; `workers` for the paper's rule (as many as there are workers); `auto` for the
            square root of the number of frames, rounded up, which does not depend on the machine.
        workers: number of workers at the start.

    Returns:
        At least 1, at most `frames`.

    Raises:
        SettingsError: `choice` is none of these.
    """
    if choice == "auto":
        return math.ceil(math.sqrt(frames))
    if choice == "workers":
        return min(max(workers, 1), frames)
    if isinstance(choice, bool) or not isinstance(choice, int) or choice < 1:
        raise SettingsError(
            f"--selected-frames: {choice!r} is not valid: give auto, workers or a number of at least 1"
        )
    return min(choice, frames)


def make_tasks(settings: RenderSettings, selected: Sequence[int]) -> tuple[Task, ...]:
    """All tasks of a run, each after what it needs.

    The arguments of every task are the same plain keys: `frames` (frame numbers), `cache` (the files of
    the cache that it reads, relative to the run directory), `inputs` (further files that it reads) and `round` (of
    the audit, else 0). The last output of every task is its result file.

    Args:
        settings: of the run.
        selected: numbers of the frames that the first pass visits, ascending; of no meaning in modes
            without a shared cache.
    """
    if settings.mode != "two-pass":
        return tuple(_shade(frame, [], ()) for frame in settings.frames)
    tasks = [_task("gather", f"{n:05d}", gathered_cache(n), frames=[n]) for n in selected]
    gathers = tuple(task.key for task in tasks)
    tasks.append(
        _task("merge", "", merged_cache(), needs=gathers, inputs=[gathered_cache(n) for n in selected])
    )
    cache, last = merged_cache(), "merge"
    if settings.coverage == "full":
        for audit_round in range(1, AUDIT_ROUNDS + 1):
            tasks += _audit(settings.frames, audit_round, cache, last)
            cache, last = covered_cache(audit_round), tasks[-1].key
        tasks.append(_task("finish", "", finished_cache(), needs=(last,), cache=[cache]))
        cache, last = finished_cache(), "finish"
    return (*tasks, *(_shade(frame, [cache], (last,)) for frame in settings.frames))


def _audit(frames: Sequence[int], audit_round: int, cache: str, need: str) -> list[Task]:
    """One round of the audit: a task for each chunk of frames, and one that adds what they missed."""
    chunks = [list(frames[first : first + AUDIT_CHUNK]) for first in range(0, len(frames), AUDIT_CHUNK)]
    audits = [
        _task(
            "audit",
            f"{audit_round}-{number:04d}",
            audit_points(audit_round, number),
            needs=(need,),
            frames=chunk,
            cache=[cache],
            audit_round=audit_round,
        )
        for number, chunk in enumerate(chunks, start=1)
    ]
    cover = _task(
        "cover",
        f"{audit_round}",
        covered_cache(audit_round),
        needs=tuple(audit.key for audit in audits),
        cache=[cache],
        inputs=[audit.outputs[0] for audit in audits],
        audit_round=audit_round,
    )
    return [*audits, cover]


def _shade(frame: int, cache: list[str], needs: tuple[str, ...]) -> Task:
    return _task(
        "shade", f"{frame:05d}", RunDirectory.frame_name(frame), needs=needs, frames=[frame], cache=cache
    )


def _task(
    stage: str,
    number: str,
    output: str,
    *,
    needs: tuple[str, ...] = (),
    frames: list[int] | None = None,
    cache: list[str] | None = None,
    inputs: list[str] | None = None,
    audit_round: int = 0,
) -> Task:
    key = f"{stage}-{number}" if number else stage
    arguments: dict[str, Any] = {
        "frames": frames or [],
        "cache": cache or [],
        "inputs": inputs or [],
        "round": audit_round,
    }
    outputs = (output, RunDirectory.result_name(key))
    return Task(key=key, stage=stage, outputs=outputs, needs=needs, arguments=arguments)


@dataclass(frozen=True)
class Cost:
    """Roughly what a run asks of the machine; a record's number is known only after the first pass.

    Attributes:
        camera_samples: samples through pixels of all frames of the second pass.
        first_pass_rays: least number of first-pass rays (base rays of each selected frame), 0 without one.
        audit_rays: rays of the coverage audit at one per pixel and round, 0 without one.
        paths_per_record: paths that one record costs, 0 without a cache.
        path_segments: most indirect segments of one of these paths (of one camera path in mode path).
    """

    camera_samples: int
    first_pass_rays: int
    audit_rays: int
    paths_per_record: int
    path_segments: int


def estimate_cost(settings: RenderSettings, selected: Sequence[int]) -> Cost:
    """Rough cost of a run from its settings alone."""
    pixels = settings.width * settings.height * len(settings.frames)
    shared = settings.mode == "two-pass"
    audited = shared and settings.coverage == "full"
    cached = settings.mode != "path"
    return Cost(
        camera_samples=pixels * settings.spp,
        first_pass_rays=settings.base_rays * len(selected) if shared else 0,
        audit_rays=pixels * AUDIT_ROUNDS if audited else 0,
        paths_per_record=settings.cache.paths_per_record if cached else 0,
        path_segments=settings.bounces,
    )

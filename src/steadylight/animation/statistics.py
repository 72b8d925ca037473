"""Statistics of a run, from its files: the content of `stats.json`.

Counts come from the results of finished tasks, times from the journal and the sessions, so they are correct however
often the run was interrupted and resumed.

Seconds of a pass are wall-clock time during which at least one task of the pass was running, including failed attempts.
`seconds_cpu` is summed over the processes of all workers. `makespan_s` is summed over sessions, each from the start of
the command until its last task was done. The time between sessions does not count; a killed session counts up to its
last finished attempt.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from steadylight.animation.plan import STAGES, audit_rounds
from steadylight.engines import Attempt, Task

if TYPE_CHECKING:
    from steadylight.renderers.base import Renderer
    from steadylight.settings import RenderSettings


class Planned(Protocol):
    """What statistics need to know about a run."""

    @property
    def settings(self) -> RenderSettings:
        """The settings that determine the bytes."""

    @property
    def selected(self) -> tuple[int, ...]:
        """Numbers of the first-pass frames."""

    @property
    def renderer(self) -> Renderer:
        """The renderer of the run."""

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks of the run."""


def journal_entry(attempt: Attempt) -> dict[str, Any]:
    """An attempt as a line of the journal."""
    return {
        "task": attempt.task.key,
        "stage": attempt.task.stage,
        "outcome": attempt.outcome,
        "attempt": attempt.attempt,
        "seconds": round(attempt.seconds, 6),
        "seconds_cpu": round(attempt.seconds_cpu, 6),
        "worker": attempt.worker,
        **({"cause": attempt.cause} if attempt.cause else {}),
        "result": dict(attempt.result),
    }


def collect_statistics(
    request: Planned,
    variant: str,
    *,
    results: Mapping[str, Mapping[str, Any]],
    journal: Sequence[Mapping[str, Any]],
    sessions: Sequence[Mapping[str, Any]],
    workers: int = 1,
) -> dict[str, Any]:
    """The content of `stats.json`, in the order of the file.

    Args:
        request: the request or the run.
        variant: backend of the renderer.
        results: what each finished task returned, by key.
        journal: lines of the journal, in the order written; `time` is when the attempt ended.
        sessions: `seconds` and `workers` of each command that worked on the run.
        workers: number of workers to record if there was no session.
    """
    settings = request.settings
    finished = [task for task in request.tasks if task.key in results]
    stages = {stage: [t for t in finished if t.stage == stage] for stage in STAGES}
    cpu = _cpu_seconds(journal)
    statistics: dict[str, Any] = {
        "mode": settings.mode,
        "frames": len(settings.frames),
        "width": settings.width,
        "height": settings.height,
        "spp": settings.spp,
        "variant": variant,
        "workers": sessions[-1]["workers"] if sessions else workers,
        "makespan_s": round(sum(float(session["seconds"]) for session in sessions), 3),
        "sessions": [dict(session) for session in sessions],
        "selected_frames": list(request.selected),
    }
    if settings.mode == "two-pass":
        first, merge, audit = (
            ("prepare", "look", "gather"),
            ("merge", "concatenate"),
            ("audit", "fill", "smooth"),
        )
        statistics["first_pass"] = (
            {"method": settings.first_pass}
            | _sums(
                [task for stage in first for task in stages[stage]],
                results,
                "rays",
                "hits",
                "misses",
                "left",
                "records",
            )
            | {
                "seconds": _busy(journal, *first),
                "seconds_cpu": _total(cpu, *first),
            }
        )
        statistics["merge"] = _sums(stages["merge"], results, "records_in", "records_out") | {
            "seconds": _busy(journal, *merge),
            "seconds_cpu": _total(cpu, *merge),
        }
        if audit_rounds(settings, request.renderer.capabilities):
            statistics["coverage"] = _coverage(stages, results) | {
                "seconds": _busy(journal, *audit),
                "seconds_cpu": _total(cpu, *audit),
            }
    statistics["second_pass"] = _second_pass(stages["shade"], results) | {
        "seconds": _busy(journal, "shade"),
        "seconds_cpu": _total(cpu, "shade"),
    }
    statistics["tasks"] = _task_counts(len(finished), journal)
    return statistics


def _coverage(
    stages: Mapping[str, Sequence[Task]], results: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """The audit, summed over all rounds."""
    fills = stages["fill"]
    rounds = max((task.arguments["round"] for task in fills), default=0)
    return {
        "rounds": rounds,
        **_sums(stages["audit"], results, "looked_up", "missed"),
        **_sums(fills, results, "records"),
        **_sums(stages["smooth"], results, "stretched"),
    }


def _second_pass(shades: Sequence[Task], results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The frames: seconds of each, misses, which frames are black, and the light removed with fireflies."""
    frame_seconds = [results[task.key].get("seconds", 0.0) for task in shades]
    lost = [results[task.key].get("firefly_loss", 0.0) for task in shades]
    return {
        "frame_seconds": frame_seconds,
        **_sums(shades, results, "missed", "new_records"),
        "black_frames": [task.arguments["frames"][0] for task in shades if results[task.key].get("black")],
        "firefly_loss": round(sum(lost) / len(lost), 6) if lost else 0.0,
    }


def _sums(tasks: Sequence[Task], results: Mapping[str, Mapping[str, Any]], *names: str) -> dict[str, Any]:
    """Each named number, summed over the results of the tasks."""
    return {name: sum(results[task.key].get(name, 0) for task in tasks) for name in names}


def _cpu_seconds(journal: Sequence[Mapping[str, Any]]) -> list[tuple[str, float]]:
    """Stage and CPU seconds of every attempt, including failed ones, which cost time too."""
    return [(str(line.get("stage")), float(line.get("seconds_cpu", 0.0))) for line in journal]


def _total(costs: Sequence[tuple[str, float]], *stages: str) -> float:
    return round(sum(seconds for name, seconds in costs if name in stages), 6)


def _task_counts(done: int, journal: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    outcomes = Counter(line.get("outcome") for line in journal)
    causes = Counter(str(line["cause"]) for line in journal if line.get("cause"))
    avoided = [line.get("result", {}).get("host_avoided") for line in journal]
    return {
        "done": done,
        "attempts": len(journal),
        "failed": outcomes["failed"],
        "lost": outcomes["lost"],
        "causes": dict(sorted(causes.items())),
        "hosts_avoided": sorted({host for host in avoided if host}),
    }


def _busy(journal: Sequence[Mapping[str, Any]], *stages: str) -> float:
    """Seconds during which at least one attempt at a task of these stages was running."""
    return busy_seconds(line for line in journal if line.get("stage") in stages)


def busy_seconds(lines: Iterable[Mapping[str, Any]]) -> float:
    """Wall-clock seconds during which at least one of the attempts was running."""
    intervals = sorted((line["time"] - line["seconds"], line["time"]) for line in lines)
    total, until = 0.0, float("-inf")
    for start, end in intervals:
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return round(total, 6)

"""Console output of finished commands: tables and lines."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from steadylight.progress import PASSES, black_frames, counted, duration
from steadylight.quality import FEW_FRAMES

if TYPE_CHECKING:
    # Importing these takes a second, too long for `--help`.
    from steadylight.animation.cost import Cost
    from steadylight.animation.request import Request
    from steadylight.animation.run import Run
    from steadylight.animation.simulation import Outcome
    from steadylight.metrics.compare import Comparison
    from steadylight.scenes.description import Note
    from steadylight.walking.checks import Checked

# Without markup and emoji, because file names may contain brackets and colons.
out = Console(highlight=False, markup=False, emoji=False)
err = Console(stderr=True, highlight=False, markup=False, emoji=False)


def show_run(run: Run) -> None:
    """Print what a finished run produced, and where it is."""
    second = run.statistics["second_pass"]
    count = len(run.frames)
    misses = f", {counted(second['missed'], 'miss', 'misses')} in the second pass"
    out.print(
        f"Done: {counted(count, 'frame', 'frames')} in {duration(run.statistics['makespan_s'])}"
        f"{misses if run.statistics['mode'] == 'two-pass' else ''}."
    )
    for line in _troubles(run.statistics["tasks"]):
        out.print(line, style="yellow", soft_wrap=True)
    if second["black_frames"]:
        out.print(f"  Warning: {black_frames(second['black_frames'])}", style="yellow", soft_wrap=True)
    places = {"frames": run.frames[0].parent, "video": run.video, "report": run.report}
    pictures = run.directory / "pictures"
    if pictures.is_dir():
        places["pictures"] = pictures
    for name, path in places.items():
        out.print(f"  {name:<8} {path}", soft_wrap=True)


_CAUSES = {
    "task": "an error in the task",
    "input": "wrong input",
    "storage": "the run directory could not be written",
    "host": "a machine lacked a library, memory or disk space",
    "lost": "a worker was lost",
    "hung": "a worker hung",
    "walltime": "a job reached its time limit",
}


def _troubles(tasks: Mapping[str, Any]) -> Iterator[str]:
    """Problems from which the run recovered, one line each."""
    for cause, times in tasks.get("causes", {}).items():
        again = counted(times, "attempt", "attempts")
        yield f"  {again} repeated: {_CAUSES.get(cause, cause)}"
    if tasks.get("hosts_avoided"):
        yield f"  hosts avoided for a while: {', '.join(tasks['hosts_avoided'])}"


_MOST_NOTES = 6
"""Maximum number of lines about one kind of note, half as many for conversions; `run.json` has all of them."""

_HEADINGS = {
    "warning": "warnings",
    "left out": "left out",
    "approximated": "approximated",
    "converted": "converted",
}


def show_notes(notes: Sequence[Note]) -> None:
    """Print what became of a scene file: most important notes first, equal ones merged, long lists shortened."""
    for kind, heading in _HEADINGS.items():
        places: dict[str, list[str]] = {}
        for note in notes:
            if note.kind == kind:
                places.setdefault(note.text, []).append(note.where)
        if not places:
            continue
        most = _MOST_NOTES // 2 if kind == "converted" else _MOST_NOTES
        for text, where in list(places.items())[:most]:
            more = f" and {len(where) - 2} more" if len(where) > 2 else ""
            line = f"  {heading:<12}  {', '.join(where[:2])}{more}: {text}"
            out.print(line, style="yellow" if kind == "warning" else None, soft_wrap=True)
        if len(places) > most:
            out.print(f"  {heading:<12}  ... and {len(places) - most} more", soft_wrap=True)


def show_plan(request: Request) -> None:
    """Print what a run would do."""
    settings, cost = request.settings, request.probed_cost
    numbers = settings.frames
    rows = {
        "scene": f"{request.scene.name} ({request.source})",
        "frames": f"{len(numbers)}: {_shortened(numbers)}",
        "image": f"{settings.width}x{settings.height}, {settings.spp} samples per pixel",
        "frame rate": f"{settings.fps:g} frames per second",
        "renderer": settings.renderer,
        "mode": settings.mode,
    }
    if request.selected:
        rows["selected frames"] = f"{len(request.selected)}: {_shortened(request.selected)}"
    if settings.record_spacing > 1:
        further = f"{settings.record_spacing:.2g} times as far apart"
        rows["short animation"] = f"records {further} as with {FEW_FRAMES} frames or more"
    if settings.cache_parts > 1:
        seen = [len(window) for window in request.survey.windows]
        rows["cache"] = (
            f"{settings.cache_parts} parts, of which a window of frames reads {sum(seen) / len(seen):.1f} on average"
        )
    if settings.denoise:
        rows["denoising"] = "direct light and glossy reflections"
    stages = [task.stage for task in request.tasks]
    counts = [f"{stages.count(stage)} {stage}" for stage in PASSES if stage in stages]
    rows["tasks"] = f"{len(stages)}: {', '.join(counts)}"
    rows["camera samples"] = f"{cost.camera_samples:,}"
    if cost.first_pass_rays:
        rows["first-pass rays"] = (
            f"at least {cost.first_pass_rays:,}, until {settings.threshold:g} hits per miss"
        )
    if cost.audited_frames:
        rounds = counted(cost.audited_frames // len(numbers), "round", "rounds")
        rows["coverage audit"] = f"{rounds} over all frames"
    rows |= zip(("time", "memory", "disk"), cost_words(cost), strict=True)
    rows["run directory"] = request.place
    show_table("plan", rows)
    show_notes(request.scene.notes)


def show_path(checked: Checked | None) -> None:
    """Print how near the camera comes to surfaces, and on which frames something is wrong."""
    if checked is None:
        return
    if not checked.warnings:
        frame, nearest = min(checked.clearance.items(), key=lambda each: each[1])
        if nearest < 10:
            out.print(f"Camera path: clear of all surfaces, nearest at frame {frame} ({nearest:.2f} m).")
        return
    for warning in checked.warnings[:_MOST_WARNINGS]:
        out.print(f"Warning: camera path: {warning}", style="yellow", soft_wrap=True)
    rest = len(checked.warnings) - _MOST_WARNINGS
    if rest > 0:
        out.print(f"Warning: camera path: {rest} more like these", style="yellow")


_MOST_WARNINGS = 8


def usable_cores() -> int:
    """Cores of this machine that the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cost_words(cost: Cost, part: float = 1.0) -> tuple[str, str, str]:
    """Rough time, memory and disk space of a run, or of the `part` of it that is left."""
    cores = usable_cores()
    time = duration(part * cost.seconds_cpu / cores)
    known = "within a factor of three" if cost.probed else "or up to ten times that in a cluttered room"
    return (
        f"about {time} on {counted(cores, 'core', 'cores')}, {known}",
        f"about {_bytes(cost.memory)} of memory for each worker",
        f"about {_bytes(part * cost.disk)} of disk space for the frames",
    )


def _bytes(number: float) -> str:
    return f"{number / 1e9:.1f} GB" if number >= 1e8 else f"{number / 1e6:.1f} MB"


def show_simulation(nodes: int, outcomes: Mapping[str, Outcome]) -> None:
    """Print simulated makespan and efficiency, one line for each way to plan the run."""
    rows = {
        name: f"{duration(outcome.makespan)}, efficiency {outcome.efficiency:.0%}, "
        f"{outcome.bytes_moved / 1e9:.2f} GB moved, "
        f"{counted(outcome.failures, 'node failure', 'node failures')}"
        for name, outcome in outcomes.items()
    }
    show_table(f"simulated on {counted(nodes, 'node', 'nodes')}", rows)


def show_comparison(comparison: Comparison) -> None:
    """Print the measures of two runs as a table, and how much less the second one flickers."""
    animations = {"first": comparison.a, "second": comparison.b, "reference": comparison.reference}
    shown = {name: each for name, each in animations.items() if each is not None}
    table = Table(title=f"{len(comparison.frames)} frames; errors averaged over {len(comparison.compared)}")
    table.add_column("measure")
    for name, each in shown.items():
        table.add_column(f"{name}\n{each.path}", justify="right", overflow="fold")
    for measure in comparison.a.means():
        values = [each.means()[measure] for each in shown.values()]
        table.add_row(measure, *("-" if value is None else f"{value:.5g}" for value in values))
    out.print(table)
    truth = (
        "the first run" if comparison.reference is None and comparison.a.errors is None else "the reference"
    )
    for name, each in (("first", comparison.a), ("second", comparison.b)):
        ratio = each.means()["brightness_ratio"]
        if ratio is not None:
            shift = "as bright as" if abs(ratio - 1) < 5e-4 else f"{abs(ratio - 1):.1%} {_shade(ratio)} than"
            out.print(f"brightness: the {name} run is {shift} {truth}")
    out.print(_noise_of(comparison, truth), soft_wrap=True)
    for name, ratio in (
        ("overshoot", comparison.overshoot_ratio),
        ("BFM excess", comparison.bfm_excess_ratio),
    ):
        if ratio is not None:
            out.print(f"{name}: the first run has {ratio:.3g} times that of the second")


def _shade(ratio: float) -> str:
    return "brighter" if ratio > 1 else "darker"


def _noise_of(comparison: Comparison, truth: str) -> str:
    """How noisy the ground truth is, and what that means for the errors."""
    if comparison.truth_b is not None:
        return (
            f"noise: the mean of both references has {comparison.noise:.2%}; rel_rmse and rel_bias exclude it"
        )
    line = f"noise: {truth} has about {comparison.noise:.1%} of its own (estimated)"
    smallest = min(
        value for each in (comparison.a, comparison.b) if (value := each.means()["rel_trimmed"]) is not None
    )
    if 4 * comparison.noise > smallest:
        line += ", too much for these errors: give more samples, or --reference-b with another --seed"
    return line


def show_table(title: str, rows: Mapping[str, str]) -> None:
    """Print a title and lines of name and value, readable on a terminal and in a log."""
    width = max(map(len, rows))
    out.print(title, style="bold", soft_wrap=True)
    for name, value in rows.items():
        out.print(f"  {name:<{width}}  {value}", soft_wrap=True)


def _shortened(numbers: tuple[int, ...]) -> str:
    if len(numbers) > 12:
        return f"{', '.join(map(str, numbers[:5]))} ... {numbers[-1]}"
    return ", ".join(map(str, numbers))

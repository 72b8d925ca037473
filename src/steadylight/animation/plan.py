"""The two passes as data: turns settings into tasks with dependencies and files; imports no renderer.

With `--first-pass surface`:

```
look-0001 ┐                        ┌ audit-1-0001 ┐                 ┌ shade-00001
look-0002 ┼─ gather-000 ┐          ┼ audit-1-0002 ┼─ fill-1 ─ smooth ┼ shade-00002
...       │             ├─ merge ─ ┼ ...          ┘                 └ ...
prepare   ┴─ gather-001 ┘
```

Frames also read the output of `prepare`.

With `--first-pass frames`, as published, plus our audit:

```
gather-00012 ─┐         ┌ audit-1-0001 ┐          ┌ audit-2-0001 ┐                  ┌ shade-00001
gather-00031 ─┼─ merge ─┼ audit-1-0002 ┼─ fill-1 ─┼ audit-2-0002 ┼─ fill-2 ─ smooth ┼ shade-00002
gather-00057 ─┘         └ ...          ┘          └ ...          ┘                  └ ...
```

The stages of a run depend on the renderer's capabilities (`renderers.base.Capabilities`) and on the settings. With
`--coverage off`, the second pass directly follows the merge. Modes without a shared cache only have tasks of the second
pass.

A cache in parts (`renderers.base.Survey`) has a merge, a fill and a smooth task for each part and round. Each of them,
and each audit and frame, waits only for the parts that it reads: there is no barrier between the passes. A task reads
exactly the files listed here, so its output does not depend on when it starts.

Nothing here depends on the number of workers: the same settings always give the same tasks, so that the output does not
depend on the machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal

from steadylight.animation.cache_tasks import Files, SharedCache, State, make_task
from steadylight.engines import Task
from steadylight.errors import SettingsError
from steadylight.renderers.base import Capabilities, Job, Survey
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings
from steadylight.storage import RunDirectory

STAGES: Final = (
    "prepare",
    "look",
    "gather",
    "merge",
    "audit",
    "fill",
    "smooth",
    "shade",
    "aovs",
    "concatenate",
)
"""All stages of tasks, in the order of the method."""

FRAMES_PER_WINDOW: Final = 8
"""Frames per window, which one task audits: fixed, so that records do not depend on the number of workers."""

FEWEST_FRAMES_IN_PARTS: Final = 400
FRAMES_PER_PART: Final = 20
MOST_PARTS: Final = 64
"""Defaults for splitting the cache: minimum length of the animation, minimum frames per part, maximum number of parts.
Filling or smoothing a part is one task, for which others wait."""

PIXELS_PER_BOX: Final = 1 << 18
MOST_BOXES: Final = 64
"""With a cache in one part: pixels of the whole animation per box of space, whose records one task makes, and maximum
number of boxes. Seven boxes instead of two made 3 % more records in the same time (gallery). One box may take twice as
long as another with the same number of points, so with few boxes, workers wait for the last one."""

BOXES_PER_PART: Final = 4
"""Boxes of each part, with a cache in several parts. It does not depend on the length of the film, since the number of
records in a part follows from its surfaces. With four boxes on as many workers, a part takes 0.7 times as long, and
gets 5 % more records (temple)."""

SCENE_FILE: Final = "scene.zip"
"""The scene for the workers, relative to the run directory."""


def selected_count(frames: int, choice: int | Literal["auto", "workers"], workers: int) -> int:
    """Number of first-pass frames.

    Args:
        frames: number of frames of the animation.
        choice: a number; `workers` for the paper's rule (one frame per worker); `auto` for the square root of the
            number of frames, rounded up, which does not depend on the machine.
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
            f"--selected-frames: {choice!r} is not valid; give auto, workers or a positive whole number"
        )
    return min(choice, frames)


def part_count(frames: int, choice: int | Literal["auto"], *, shared: bool) -> int:
    """Number of parts of the shared cache.

    Args:
        frames: number of frames of the animation.
        choice: a number, or `auto`: 1 for short animations, otherwise the largest power of two with at least
            FRAMES_PER_PART frames per part. It depends only on the animation, so that the output does not depend on
            the machine.
        shared: whether a cache in parts is possible: it must be shared by all frames, and no frame may add records.

    Raises:
        SettingsError: several parts are requested but not possible.
    """
    if choice == "auto":
        few = frames < FEWEST_FRAMES_IN_PARTS or not shared
        return 1 if few else min(MOST_PARTS, 1 << int(math.log2(frames / FRAMES_PER_PART)))
    if choice > 1 and not shared:
        raise SettingsError(
            f"--cache-parts: {choice} needs --mode two-pass, --coverage full and a renderer that supports parts; "
            "give auto or 1"
        )
    return choice


def files_read(task: Task) -> tuple[str, ...]:
    """Files that a task reads, besides the scene, relative to the run directory."""
    return tuple(name for kind in ("cache", "inputs", "prepared") for name in task.arguments.get(kind, ()))


def windows_of(frames: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """The frames grouped into windows that are audited together."""
    return tuple(
        tuple(frames[first : first + FRAMES_PER_WINDOW]) for first in range(0, len(frames), FRAMES_PER_WINDOW)
    )


def make_job(
    scene: SceneDescription,
    settings: RenderSettings,
    variant: str,
    selected: Sequence[int],
    survey: Survey | None = None,
) -> Job:
    """What a renderer needs to know about a run.

    Args:
        scene: the scene, with the camera path that the frames follow.
        settings: settings of the run.
        variant: name of the renderer's backend.
        selected: numbers of the first-pass frames.
        survey: the parts of the cache; one part if None.
    """
    windows = windows_of(settings.frames)
    poses = scene.camera.frame_poses(settings.frames, settings.fps)
    return Job(
        scene=scene,
        settings=settings,
        variant=variant,
        poses=dict(zip(settings.frames, poses, strict=True)),
        windows=windows,
        selected=tuple(selected),
        survey=survey or Survey.undivided(len(windows)),
    )


def audit_rounds(settings: RenderSettings, can: Capabilities) -> int:
    """Number of audit rounds, each of which checks all frames for points that the cache does not cover."""
    if settings.first_pass == "surface":
        return 1
    return can.audit_rounds if settings.mode == "two-pass" and settings.coverage == "full" else 0


def make_tasks(
    settings: RenderSettings,
    selected: Sequence[int],
    can: Capabilities,
    survey: Survey | None = None,
    *,
    aovs: bool = False,
) -> tuple[Task, ...]:
    """All tasks of a run, each after the tasks that it needs.

    The arguments of every task have the same keys: `frames` (frame numbers), `cache` (the files of the cache that
    it reads, relative to the run directory), `inputs` (further files that it reads), `windows` (the window of each
    input, counted from 0, for fill, smooth, and gather of a box), `prepared` (a list with the output of `prepare`, if
    the task reads it), `round` (of the audit, otherwise 0), `part` (of the cache, otherwise 0) and `box` (for gather
    of a box: its number in the part, and the number of boxes there). The last output of every task is its result file.

    Args:
        settings: settings of the run.
        selected: numbers of the first-pass frames, ascending; ignored in modes without a shared cache.
        can: what the renderer can do.
        survey: the parts of the cache; one part if None.
        aovs: whether depth, normal and position of each pixel are also written.
    """
    seen = [
        make_task("aovs", f"{n:05d}", Files(frames=(n,)), RunDirectory.aovs_name(n))
        for n in (settings.frames if aovs else ())
    ]
    if settings.mode != "two-pass":
        shades = [
            make_task("shade", f"{n:05d}", Files(frames=(n,)), RunDirectory.frame_name(n))
            for n in settings.frames
        ]
        return (*shades, *seen)
    windows = windows_of(settings.frames)
    survey = survey or Survey.undivided(len(windows))
    by_surfaces = settings.first_pass == "surface"
    shared = SharedCache(survey, windows, can, by_surfaces=by_surfaces)
    tasks = shared.prepares()
    if by_surfaces:
        boxes = _boxes(settings, survey.parts)
        tasks += shared.looks() + shared.boxes(boxes) + shared.merges_of_boxes(boxes)
    else:
        tasks += shared.gathers(selected) + shared.merges(selected)
    state = State("merged", "merge")
    rounds = audit_rounds(settings, can)
    for audit_round in range(1, rounds + 1):
        tasks += shared.audits(audit_round, state)
        tasks += shared.fills(audit_round, state)
        state = State(f"filled_{audit_round}", f"fill-{audit_round}")
    # Without an audit, frames add their own records, and the renderer smooths when it has these.
    if can.smoothing and (rounds or not can.audit_rounds):
        tasks += shared.smooths(state, rounds if by_surfaces else 0)
        state = State("smoothed", "smooth")
    return (*tasks, *shared.shades(state), *seen, *shared.concatenate())


def _boxes(settings: RenderSettings, parts: int) -> int:
    """Number of boxes in each part of the cache; one task makes the records of a box."""
    if parts > 1:
        return BOXES_PER_PART
    pixels = len(settings.frames) * settings.width * settings.height
    return min(MOST_BOXES, math.ceil(pixels / PIXELS_PER_BOX))

"""Makes a preview: examines the scene along the camera path, and writes the page and the contact sheet."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadylight.animation.clearance import check_camera
from steadylight.animation.request import request_of
from steadylight.atomic_file import atomic_write
from steadylight.camera import Pose
from steadylight.errors import SettingsError
from steadylight.images import validate_png, write_png
from steadylight.preview.frames import Thumbnail, Tracer, quick_frames
from steadylight.preview.plan_view import Plan, draw_plan
from steadylight.preview.sheet import Words, contact_sheet
from steadylight.preview.size import Room, different_rooms, doubts, eye_heights, room_at
from steadylight.renderers import geometry_of
from steadylight.report.preview import PreviewPage, preview_page
from steadylight.settings import CameraOptions, Options
from steadylight.walking.space import Frame

if TYPE_CHECKING:
    from steadylight.animation.request import Request
    from steadylight.preview.options import PreviewOptions
    from steadylight.renderers.base import Geometry
    from steadylight.scenes.description import Note
    from steadylight.settings import SceneOptions

_ALONG = 300
"""Maximum number of places along the path at which its height is measured, and through which it is drawn."""
_LOOKS = 6
"""Number of views around a camera that stands still."""


@dataclass(frozen=True)
class Preview:
    """What was found and written.

    Attributes:
        page: the HTML page.
        sheet: the PNG picture.
        facts: what was understood: sizes, lights, camera.
        warnings: what is likely wrong.
        notes: notes on what was converted, approximated or left out.
    """

    page: Path
    sheet: Path
    facts: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[Note, ...]


def make_preview(scene: str, scene_options: SceneOptions, options: PreviewOptions) -> Preview:
    """Examine a scene, and write the page and the picture.

    Raises:
        InputError: the scene, the camera or an option is wrong.
        StorageError: the output cannot be written.
    """
    request = request_of(
        scene,
        Options.checked(
            **dict(scene_options),
            **options.values_of(CameraOptions),
            renderer=options.renderer,
            mode="path",
        ),
    )
    page, sheet = _outputs(request, options)
    backend = request.renderer.check(request.scene, request.settings, request.execution.variant, build=True)
    geometry = geometry_of(request.scene, request.renderer.name, request.execution.variant)
    seen = _Seen.along(request, geometry, options.pictures)
    tracer = Tracer(request.renderer, backend.variant, options.seconds)
    frames = quick_frames(request.scene, seen.poses, tracer, geometry)
    checked = check_camera(request, geometry) if geometry is not None else None
    warnings = [*seen.doubts, *(f"camera path: {each}" for each in (checked.warnings if checked else ()))]
    facts = [*seen.facts, *_content(request, geometry), _camera_fact(request)]
    if checked is not None and checked.clearance and not checked.warnings:
        nearest = min(checked.clearance.values())
        if np.isfinite(nearest):
            facts.append(f"the camera stays {nearest:.2f} m away from all surfaces")
    made = Preview(page, sheet, tuple(facts), tuple(warnings), request.scene.notes)
    _write(request, made, seen, frames)
    return made


def _outputs(request: Request, options: PreviewOptions) -> tuple[Path, Path]:
    """The files to write."""
    if options.output is None:
        name = re.sub(r"[^\w.-]+", "-", request.title).strip(".-") or "scene"
        page = Path(f"{name}-preview.html")
    else:
        page = Path(options.output)
        if page.suffix.lower() != ".html":
            raise SettingsError(f"--output: {page}: a preview is a page; give a name that ends in .html")
    return page, page.with_suffix(".png")


@dataclass(frozen=True)
class _Seen:
    """What was found with rays along the path.

    Attributes:
        poses: poses of the pictures, by number.
        captions: captions of the pictures, by number.
        plan: plan from above; None without geometry.
        frames: frame numbers along the path at which heights were measured.
        heights: height of the eye at each of `frames`, metres; NaN if unknown.
        rooms: rooms around the poses of the path that are pictured.
    """

    poses: Mapping[int, Pose]
    captions: Mapping[int, str]
    plan: Plan | None
    frames: tuple[int, ...]
    heights: NDArray[np.float64]
    rooms: tuple[Room, ...]

    @classmethod
    def along(cls, request: Request, geometry: Geometry | None, count: int) -> _Seen:
        """Examine the path of a request."""
        camera, fps, numbers = request.scene.camera, request.settings.fps, request.settings.frames
        steps = np.unique(np.linspace(0, len(numbers) - 1, min(count, len(numbers))).round().astype(int))
        chosen = [numbers[step] for step in steps]
        poses = dict(zip(chosen, camera.frame_poses(chosen, fps), strict=True))
        captions = {number: f"frame {number}, {(number - 1) / fps:.1f} s" for number in chosen}
        outside = geometry is not None and _is_outside(geometry, poses[chosen[0]])
        if len(camera.keyframes) == 1:
            centre = geometry.bounds.mean(axis=0) if geometry is not None and outside else None
            poses = looking_around(poses[chosen[0]], camera.upright, centre)
            word = "turned" if centre is None else "from further round by"
            turns = {number: f"{word} {(number - 1) * 360 // _LOOKS}°" for number in poses}
            captions = turns | {1: "the view"}
            chosen = [1]
        spread = np.unique(np.linspace(0, len(numbers) - 1, min(_ALONG, len(numbers))).round().astype(int))
        frames = tuple(numbers[step] for step in spread)
        path = camera.frame_poses(frames, fps)
        if geometry is None:
            return cls(poses, captions, None, frames, np.full(len(frames), np.nan), ())
        frame = Frame(camera.upright)
        found = (room_at(geometry, frame, poses[number], number) for number in chosen)
        rooms = tuple(room for room in found if room is not None)
        heights = eye_heights(geometry, frame, np.array([pose.origin for pose in path]))
        shown = {number: poses[number] for number in chosen}
        region = _region(frame, rooms, path, geometry.bounds if outside else None)
        plan = draw_plan(geometry, frame, region, path, shown)
        return cls(poses, captions, plan, frames, heights, rooms)

    @property
    def facts(self) -> list[str]:
        """Sizes, as sentences without a full stop."""
        found = [str(room) for room in different_rooms(self.rooms)]
        known = self.heights[np.isfinite(self.heights)]
        if len(known):
            low, high = float(known.min()), float(known.max())
            span = f"{low:.2f} m" if high - low < 0.02 else f"{low:.2f} to {high:.2f} m"
            found.append(f"the eye is {span} above the floor")
        return found

    @property
    def doubts(self) -> list[str]:
        """What is probably wrong, as sentences without a full stop."""
        return doubts(self.rooms, self.heights)


def _is_outside(geometry: Geometry, pose: Pose) -> bool:
    """Whether a camera looks at the scene from outside."""
    low, high = geometry.bounds
    return bool(((pose.origin < low) | (pose.origin > high)).any())


def looking_around(
    pose: Pose, up: Sequence[float], centre: NDArray[np.float64] | None = None
) -> dict[int, Pose]:
    """A still view and further ones: in other directions from the same place, or around `centre` if given."""
    poses = {}
    for number in range(_LOOKS):
        angle = -2 * np.pi * number / _LOOKS
        turn = Rotation.from_rotvec(angle * np.asarray(up)).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3] = turn @ pose.to_world[:3, :3]
        matrix[:3, 3] = pose.origin if centre is None else centre + turn @ (pose.origin - centre)
        poses[number + 1] = Pose(matrix, pose.fov, pose.time)
    return poses


def _region(
    frame: Frame, rooms: Sequence[Room], path: Sequence[Pose], bounds: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Lowest and highest corner of a plan, (2, 2): the path and the rooms around it.

    What is seen far away through windows is left out. With `bounds`, the plan shows the whole scene.
    """
    points = [frame.local([pose.origin for pose in path])[:, :2]]
    if bounds is not None:
        points[0] = np.vstack([points[0], frame.local(bounds)[:, :2]])
    for room in rooms:
        corners = np.array([(x, y) for x in room.box[:, 0] for y in room.box[:, 1]])
        turn = np.array([[np.cos(room.yaw), -np.sin(room.yaw)], [np.sin(room.yaw), np.cos(room.yaw)]])
        points.append(corners @ turn.T)
    low, high = np.vstack(points).min(axis=0), np.vstack(points).max(axis=0)
    reach = 15.0 + 2 * float(np.ptp(points[0], axis=0).max())
    low, high = (
        np.maximum(low, points[0].min(axis=0) - reach),
        np.minimum(high, points[0].max(axis=0) + reach),
    )
    margin = 0.06 * float((high - low).max()) + 0.1
    return np.array([low - margin, high + margin])


def _content(request: Request, geometry: Geometry | None) -> list[str]:
    """Format, shapes and lights of the scene, as sentences without a full stop."""
    scene = request.scene
    found = [f"read as {scene.format}"] if scene.format != "mitsuba" else []
    if geometry is not None:
        kinds = Counter(
            lamp.kind.removesuffix("emitter").removesuffix("light") or lamp.kind for lamp in geometry.lamps
        )
        lights = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        shapes = len(geometry.shapes)
        found.append(f"{shapes} shape{'s' * (shapes != 1)}; lights: {lights or 'not known'}")
    return found


def _camera_fact(request: Request) -> str:
    camera, settings = request.scene.camera, request.settings
    if len(camera.keyframes) == 1:
        return f"the camera stands still; field of view {camera.keyframes[0].fov:.0f}°"
    count = len(settings.frames)
    ends = {round(key.fov) for key in camera.keyframes}
    fov = f"{min(ends)}°" if len(ends) == 1 else f"{min(ends)} to {max(ends)}°"
    return f"{count} frames, {count / settings.fps:.1f} s at {settings.fps:g} frames per second; field of view {fov}"


def _exposed(stops: float) -> str:
    """Caption for a picture shown a stop or more brighter or darker than the others; otherwise empty."""
    return f", exposed {stops:+.0f} EV" if abs(stops) >= 1 else ""


def _write(request: Request, made: Preview, seen: _Seen, frames: Mapping[int, Thumbnail]) -> None:
    """Write picture and page."""
    title = request.title
    pictures = {
        seen.captions[number] + _exposed(frame.stops): frame.pixels for number, frame in frames.items()
    }
    notes = [f"{note.kind}: {note.where}: {note.text}" for note in made.notes]
    most = 14
    shown = [
        *made.facts,
        *notes[:most],
        *([f"and {len(notes) - most} more notes"] if len(notes) > most else []),
    ]
    plan = None if seen.plan is None else seen.plan.pixels
    sheet = contact_sheet(Words(title, shown, made.warnings), pictures, plan, seen.heights)
    page = preview_page(
        PreviewPage(
            title=title,
            pictures=pictures,
            plan=plan,
            plan_says=_plan_words(request, seen),
            heights=_known(seen),
            facts=made.facts,
            warnings=made.warnings,
            notes=[(note.kind, note.where, note.text) for note in made.notes],
        )
    )
    with atomic_write(made.sheet, validate_png) as temporary:
        write_png(temporary, sheet)
    with atomic_write(made.page) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _known(seen: _Seen) -> tuple[list[int], list[float]]:
    """Frame numbers and heights where there is a floor; empty for a still view."""
    if len(seen.frames) < 2:
        return [], []
    known = np.isfinite(seen.heights)
    return np.array(seen.frames)[known].tolist(), seen.heights[known].tolist()


def _plan_words(request: Request, seen: _Seen) -> str:
    if seen.plan is None:
        return ""
    moves = "the camera path" if len(request.scene.camera.keyframes) > 1 else "the camera"
    return (
        f"Plan from above, cut above eye height, {seen.plan.metres:.1f} m wide, with {moves} and the lights"
    )


def plain(preview: Preview) -> dict[str, Any]:
    """The preview as plain data (JSON)."""
    notes = [{"kind": note.kind, "where": note.where, "text": note.text} for note in preview.notes]
    return {
        "page": str(preview.page),
        "sheet": str(preview.sheet),
        "facts": list(preview.facts),
        "warnings": list(preview.warnings),
        "notes": notes,
    }

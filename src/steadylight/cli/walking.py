"""Command `walk`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from steadylight.cli.application import app
from steadylight.cli.options import SceneArgument, with_options
from steadylight.display import out, show_path
from steadylight.errors import SettingsError
from steadylight.settings import SceneOptions
from steadylight.walking.options import WalkOptions, axis_of, point_of

if TYPE_CHECKING:
    from steadylight.camera import CameraPath
    from steadylight.renderers.base import Geometry
    from steadylight.scenes.description import SceneDescription
    from steadylight.walking.walk import Walker


# Points may begin with a minus sign, like options. Unknown options are therefore read as points, and refused as such.
@app.command(context_settings={"ignore_unknown_options": True})
@with_options(scene_options=SceneOptions, walk=WalkOptions)
def walk(  # noqa: PLR0913 - one for each option
    scene: SceneArgument,
    more: Annotated[
        list[str] | None, typer.Argument(metavar="[X,Y,Z]...", help="More points of --through.")
    ] = None,
    *,
    through: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z...", help="Points to pass, on the floor or at eye height.", rich_help_panel="Walk"
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="Keyframe file (.toml).", rich_help_panel="Walk"),
    ] = Path("walk.toml"),
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite the output if it exists.", rich_help_panel="Walk")
    ] = False,
    scene_options: SceneOptions,
    walk: WalkOptions,
) -> None:
    """Make a camera path at eye height that keeps its distance from walls and furniture.

    The path goes through the points of --through, or with --rooms through all rooms. It is written as keyframes for
    `render --camera`.
    """
    texts = [text for group in (through or []) for text in group.split()] + (more or [])
    wrong = next((text for text in texts if text.startswith("-") and not text[1:2].isdigit()), None)
    if wrong is not None and not wrong.startswith("-."):
        raise SettingsError(f"{wrong}: no such option; see `steadylight walk --help`")
    points = [point_of(text, "--through") for text in texts]
    if walk.rooms == bool(points):
        raise SettingsError("walk: give either --through with at least two points, or --rooms")
    if len(points) == 1:
        raise SettingsError("--through: a walk needs at least two points")
    if walk.start is not None and not walk.rooms:
        raise SettingsError(
            "--start: only with --rooms; the first point of --through is where the walk starts"
        )
    _check_output(output, force=force)
    description, geometry = _scene(scene, scene_options)
    walker = _walker(geometry, description, walk)
    if points:
        path = walker.through(points)
    else:
        camera = description.camera.pose(0.0).origin
        x, y, z = camera.tolist()
        path = walker.rooms((x, y, z) if walk.start is None else point_of(walk.start, "--start"))
    fps = walk.fps or description.fps
    _write(path, fps, output)
    _show(path, fps, geometry, output)


def _check_output(output: Path, *, force: bool) -> None:
    """Refuse an output that cannot be written, before any work is done."""
    if output.suffix.lower() != ".toml":
        raise SettingsError(f"--output: {output}: a walk is a keyframe file; give a name that ends in .toml")
    if output.exists() and not force:
        raise SettingsError(
            f"--output: {output}: exists already; choose another, or overwrite it with --force"
        )


def _scene(scene: str, options: SceneOptions) -> tuple[SceneDescription, Geometry]:
    from steadylight.errors import SceneError
    from steadylight.renderers import geometry_of
    from steadylight.scenes import read_scene

    description = read_scene(scene, options)
    geometry = geometry_of(description, "mitsuba", "auto")
    if geometry is None:
        raise SceneError(f"scene {description.name}: no installed renderer can say where its surfaces are")
    return description, geometry


def _walker(geometry: Geometry, scene: SceneDescription, walk: WalkOptions) -> Walker:
    from steadylight.walking.motion import Gait
    from steadylight.walking.space import Body
    from steadylight.walking.walk import Walker

    first = scene.camera.keyframes[0]
    return Walker(
        geometry,
        scene.camera.upright if walk.upright is None else axis_of(walk.upright),
        Body(walk.eye, walk.clearance),
        Gait(walk.speed, walk.look_ahead, walk.pitch),
        first.fov if walk.fov is None else walk.fov,
    )


def _write(path: CameraPath, fps: float, output: Path) -> None:
    from steadylight.atomic_file import atomic_write
    from steadylight.camera.keyframes import toml_of

    command = shlex.join(["steadylight", *sys.argv[1:]])
    with atomic_write(output) as temporary:
        temporary.write_text(toml_of(path, fps, command), encoding="utf-8")


def _show(path: CameraPath, fps: float, geometry: Geometry, output: Path) -> None:
    """Print length and duration of the walk, and what is wrong with it."""
    import numpy as np

    from steadylight.walking.checks import check_path

    frames = path.frame_count(fps)
    numbers = range(1, frames + 1)
    poses = path.frame_poses(numbers, fps)
    length = np.linalg.norm(np.diff([pose.origin for pose in poses], axis=0), axis=1).sum()
    out.print(
        f"{output}: {length:.1f} m in {path.duration:.1f} s, {frames} frames at {fps:g} frames per second.",
        soft_wrap=True,
    )
    show_path(check_path(geometry, dict(zip(numbers, poses, strict=True))))

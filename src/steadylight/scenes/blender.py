"""Reads Blender's .blend files: the user's own Blender exports them to USD in a separate process.

Blender is under the GPL and is no dependency of ours: its Python module is never imported here.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from steadylight.errors import BackendError, SceneError
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.usd.isolation import read_stage
from steadylight.scenes.usd.request import Request
from steadylight.settings import SceneOptions

VARIABLE: Final = "STEADYLIGHT_BLENDER"
"""Environment variable that names Blender, or a Python with the module `bpy`."""

_SCRIPT: Final = Path(__file__).with_name("blender_export.py")
_TIME_LIMIT: Final = 3600.0
_MAGIC: Final = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
"""First bytes of a .blend file: plain, or compressed with Zstandard or gzip."""


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a .blend file.

    Args:
        path: path of the file.
        options: `sensor`: a camera by its name or number; `allow_outside`: whether files outside the scene's folder
            may be read.

    Raises:
        BackendError: there is no Blender.
        SceneError: the file cannot be read.
        SettingsError: there is no such camera.
    """
    path = Path(path).absolute()
    _check(path)
    command = blender_command()
    if command is None:
        raise BackendError(
            f"{path}: is read through Blender, which was not found; install it, so that `blender` is on the PATH, or "
            f"set {VARIABLE} to its program or to a Python with the package bpy; or export the scene to USD"
        )
    with TemporaryDirectory(prefix="steadylight-") as place:
        folder = Path(place)
        facts = _exported(path, folder, command)
        _check_files(path, facts["files"], outside=bool(options.allow_outside))
        sensor = None if options.sensor is None else str(options.sensor)
        request = Request(path, sensor, bool(options.allow_outside), folder / "scene.usdc", facts)
        return read_stage(request)


def _check(path: Path) -> None:
    """Refuse a file that is not a .blend file."""
    if not path.is_file():
        raise SceneError(f"{path}: no such scene file")
    try:
        with path.open("rb") as file:
            first = file.read(8)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None
    if not first.startswith(_MAGIC):
        raise SceneError(f"{path}: is not a .blend file (it begins with {first!r})")


def _check_files(path: Path, files: Sequence[str], *, outside: bool) -> None:
    """Refuse missing files, and files outside the scene's folder unless they are allowed."""
    missing = [name for name in files if not Path(name).exists() and "<UDIM>" not in name]
    if missing:
        raise SceneError(f"{path}: files are missing: {'; '.join(missing)}")
    folder = path.parent.resolve()
    foreign = [name for name in files if not Path(name).is_relative_to(folder)]
    if foreign and not outside:
        raise SceneError(
            f"{path}: refers to {'; '.join(foreign)}, outside the scene's folder; move them there, pack them "
            "(File > External Data), or allow them with --allow-outside"
        )


def blender_command() -> list[str] | None:
    """Command line that starts Blender's Python, up to the script; None if there is no Blender."""
    named = os.environ.get(VARIABLE) or shutil.which("blender")
    if named:
        if Path(named).name.startswith("python"):
            return [named]
        return [
            named,
            "--background",
            "--factory-startup",
            "--disable-autoexec",
            "--python-exit-code",
            "3",
            "--python",
        ]
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable]
    return None


def _exported(path: Path, folder: Path, command: list[str]) -> dict[str, Any]:
    """Let Blender export a scene into a folder; returns the facts that the export does not contain.

    Raises:
        BackendError: Blender cannot be started.
        SceneError: Blender cannot read the file.
    """
    words = [*command, str(_SCRIPT), "--", str(path), str(folder)]
    try:
        done = subprocess.run(  # noqa: S603 - the user's own Blender
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=_TIME_LIMIT,
            check=False,
        )
    except OSError as error:
        raise BackendError(f"{words[0]}: cannot be started: {error.strerror}") from None
    except subprocess.TimeoutExpired:
        raise SceneError(f"{path}: Blender did not finish exporting it within {_TIME_LIMIT:g} s") from None
    report = folder / "facts.json"
    if not report.is_file():
        lines = [line.strip() for line in done.stdout.decode(errors="replace").splitlines() if line.strip()]
        faults = (
            [line for line in lines if "Error" in line or "error" in line]
            or lines
            or ["it printed no message"]
        )
        raise SceneError(f"{path}: Blender cannot export it: {faults[-1][:300]}")
    found: dict[str, Any] = json.loads(report.read_text())
    return found

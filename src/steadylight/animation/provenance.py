"""What made the bytes: the record in `run.json`, and whether a run directory may be gone on with."""

from __future__ import annotations

import dataclasses
import json
import platform
import re
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from steadylight.animation.plan import windows_of
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, SettingsError
from steadylight.renderers.base import Backend, Job, Survey
from steadylight.settings import RenderSettings, option_name
from steadylight.storage import RunDirectory

FORMAT: Final = 2
"""Of `run.json`; raised when this steadylight could not go on with what an older one has begun."""

_INCIDENTAL: Final = ("numpy", "python")
"""Whose versions are recorded but may change: they bring small numerical changes at most."""
_FEATURES = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512vl", "asimd", "sve")
_CPU_FILE = Path("/proc/cpuinfo")


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """What `run.json` says of a run, read back.

    Attributes:
        settings: that decide the bytes.
        scene_name: of the scene.
        scene_hash: `SceneDescription.hash`.
        source: name or file that the scene came from, as the user gave it.
        camera: the path that the frames follow.
        variant: backend of the renderer, such as `llvm_ad_rgb`.
        selected: numbers of the first pass's frames.
        survey: the parts of the cache.
        versions: of what made the bytes, and of Python.
        host: processor and its instruction sets.
    """

    settings: RenderSettings
    scene_name: str
    scene_hash: str
    source: str
    camera: CameraPath
    variant: str
    selected: tuple[int, ...]
    survey: Survey
    versions: Mapping[str, str]
    host: Mapping[str, Any]


def describe_run(job: Job, source: str, backend: Backend) -> dict[str, Any]:
    """The content of `run.json`: all that decides the bytes, as plain data, but for the survey (`describe_survey`).

    Args:
        job: of the run.
        source: name or file that the scene came from, as the user gave it.
        backend: of the renderer.
    """
    content = {
        "format": FORMAT,
        "settings": job.settings.model_dump(mode="json"),
        "constants": dict(backend.constants),
        "selected": list(job.selected),
        "scene": {"name": job.scene.name, "hash": job.scene.hash, "source": source},
        "camera": dataclasses.asdict(job.scene.camera),
        "variant": backend.variant,
        "versions": {**package_versions("steadylight"), **backend.versions, **package_versions(*_INCIDENTAL)},
        "host": describe_host(),
    }
    # Through JSON and back, so that it compares equal with what is read from the file.
    return dict(json.loads(json.dumps(content)))


def describe_survey(survey: Survey) -> dict[str, Any]:
    """What `run.json` says of a cache in parts, under `survey`."""
    return dict(json.loads(json.dumps(dataclasses.asdict(survey))))


def read_run(directory: RunDirectory) -> RunRecord:
    """Read and check the `run.json` of a run directory.

    Raises:
        SettingsError: not there, not readable, or of another format.
    """
    content = load_run(directory)
    try:
        camera = content["camera"]
        settings = RenderSettings.checked(**content["settings"])
        survey = Survey.undivided(len(windows_of(settings.frames)))
        if settings.cache_parts > 1:
            survey = _survey(content["survey"])
        return RunRecord(
            settings=settings,
            scene_name=content["scene"]["name"],
            scene_hash=content["scene"]["hash"],
            source=content["scene"]["source"],
            camera=CameraPath(tuple(Keyframe(**key) for key in camera["keyframes"]), camera["loop"]),
            variant=content["variant"],
            selected=tuple(content["selected"]),
            survey=survey,
            versions=content["versions"],
            host=content["host"],
        )
    except (KeyError, TypeError, ValueError, SettingsError, CameraError) as error:
        raise SettingsError(
            f"{directory.run_file}: does not describe a run of this steadylight ({error})"
        ) from None


def _survey(content: Mapping[str, Any]) -> Survey:
    windows, neighbours = (
        tuple(tuple(int(part) for part in parts) for parts in content[name])
        for name in ("windows", "neighbours")
    )
    return Survey(windows, neighbours, dict(content["details"]))


def load_run(directory: RunDirectory) -> dict[str, Any]:
    """The plain content of a `run.json` of our format.

    Raises:
        SettingsError: not there, not readable, or of another format.
    """
    content = directory.read_record()
    if content.get("format") != FORMAT:
        raise SettingsError(
            f"{directory.run_file}: run format {content.get('format')!r}; "
            f"this steadylight reads format {FORMAT}"
        )
    return content


def check_same_run(directory: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to go on in a directory that was started with something else.

    The host and the place of the scene file are recorded, but do not count: a run may move to another machine
    or working directory.

    Args:
        directory: of the run, for the message.
        then: content of its `run.json`.
        now: what `describe_run` says of the present request.

    Raises:
        SettingsError: names each difference, as it was and as it is.
    """
    differences = list(_differences(then, now))
    if differences:
        raise SettingsError(
            f"{directory}: was started with something else:\n"
            + "\n".join(f"  {line}" for line in differences)
            + "\nGo on with what it was started with, or choose another directory with --output."
        )


def _differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Each difference as a line: what, then, now."""
    before, here = _completed(then["settings"]), now["settings"]
    yield from _scene_differences(then["scene"], now["scene"])
    yield from _setting_differences(before, here)
    if then["camera"] != now["camera"]:
        yield "--camera: the camera path is another one"
    elif then["selected"] != now["selected"] and before == here:
        yield f"selected frames: {_short(then['selected'])} there, {_short(now['selected'])} here"
    if before["renderer"] != here["renderer"]:
        return  # and so its backend
    if then["constants"] != now["constants"] and before == here:
        yield f"--quality {here['quality']} stood for {then['constants']}, now for {now['constants']}"
    if then["variant"] != now["variant"]:
        yield f"--variant: {then['variant']} there, {now['variant']} here"
    # A package that only one of them used came with a setting, and that was said.
    alike = before == here
    yield from _version_differences(then["versions"], now["versions"], whole=alike)


def _completed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run of before there was some option: as if it had been left out."""
    fields = RenderSettings.model_fields.items()
    return {name: field.default for name, field in fields if not field.is_required()} | dict(settings)


def _setting_differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    if (then["width"], then["height"]) != (now["width"], now["height"]):
        sizes = [f"{each['width']}x{each['height']}" for each in (then, now)]
        yield f"--size: {sizes[0]} there, {sizes[1]} here"
    for name, value in now.items():
        if name not in {"width", "height"} and then[name] != value:
            yield f"{option_name(name)}: {_short(then[name])} there, {_short(value)} here"


def _scene_differences(then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    if then["hash"] != now["hash"]:
        if then["name"] != now["name"]:
            yield f"scene: {then['name']} there, {now['name']} here"
        else:
            yield f"scene: {now['name']} has changed since (its content, its film, or a file that it names)"


def _version_differences(then: Mapping[str, str], now: Mapping[str, str], *, whole: bool) -> Iterator[str]:
    """Differences of versions; with `whole` also of what only one of the two names."""
    for name in {**then, **now}:
        told = name in then and name in now
        if name not in _INCIDENTAL and (told or whole) and then.get(name) != now.get(name):
            yield (
                f"{name}: version {then.get(name)} there, {now.get(name)} here "
                "(its frames would not match the earlier ones)"
            )


def _short(value: object) -> str:
    """A value for a message; long lists as their first, last and number."""
    if isinstance(value, list | tuple):
        if len(value) > 6:
            return f"{value[0]} … {value[-1]} ({len(value)} of them)"
        return ", ".join(str(item) for item in value)
    return str(value)


def package_versions(*packages: str) -> dict[str, str]:
    """Versions of some packages, and of `python`, without importing them."""
    versions = {}
    for package in packages:
        try:
            versions[package] = platform.python_version() if package == "python" else version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def describe_host() -> dict[str, Any]:
    """Processor and instruction sets, as far as the system tells: they decide the last bits of a frame."""
    cpu, flags = platform.processor() or platform.machine(), set[str]()
    if _CPU_FILE.exists():
        text = _CPU_FILE.read_text(encoding="utf-8", errors="replace")
        if match := re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE):
            cpu = match[1].strip()
        if match := re.search(r"^(?:flags|Features)\s*:\s*(.+)$", text, re.MULTILINE):
            flags = set(match[1].split())
    return {
        "name": platform.node(),
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu": cpu,
        "isa": [feature for feature in _FEATURES if feature in flags],
    }

"""Provenance: the record in `run.json`, and whether a run directory may be resumed."""

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
from steadylight.errors import BackendError, CameraError, SettingsError
from steadylight.renderers.base import Backend, Job, Survey
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings, option_name
from steadylight.storage import RunDirectory

FORMAT: Final = 3
"""Format of `run.json`."""

_READABLE: Final = (2, 3)
"""Formats that this version resumes. From 3 on, the file has a checksum."""

_INCIDENTAL: Final = ("numpy", "python")
"""Packages whose versions are recorded but may change: they cause at most small numerical differences."""
_FEATURES = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512vl", "asimd", "sve")
_CPU_FILE = Path("/proc/cpuinfo")


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """Content of `run.json`, parsed.

    Attributes:
        settings: settings that determine the bytes.
        scene_hash: `SceneDescription.hash`.
        source: name or file that the scene came from, as the user gave it.
        camera: camera path of the frames.
        variant: backend of the renderer, such as `llvm_ad_rgb`.
        selected: numbers of the first-pass frames.
        survey: the parts of the cache.
        versions: versions of the packages that determine the bytes, and of Python.
        host: processor and its instruction sets.
    """

    settings: RenderSettings
    scene_hash: str
    source: str
    camera: CameraPath
    variant: str
    selected: tuple[int, ...]
    survey: Survey
    versions: Mapping[str, str]
    host: Mapping[str, Any]


def describe_run(job: Job, source: str, backend: Backend, title: str) -> dict[str, Any]:
    """The content of `run.json`: everything that determines the bytes except the survey (`describe_survey`).

    Args:
        job: the run; see `plan.make_job`.
        source: name or file that the scene came from, as the user gave it.
        backend: backend of the renderer.
        title: title of the report.
    """
    content = {
        "format": FORMAT,
        "settings": job.settings.model_dump(mode="json"),
        "constants": dict(backend.constants),
        "selected": list(job.selected),
        "scene": {
            "name": job.scene.name,
            "hash": job.scene.hash,
            "source": source,
            "title": title,
            "notes": [dataclasses.asdict(note) for note in job.scene.notes],
        },
        "camera": _plain_camera(job.scene.camera),
        "variant": backend.variant,
        "versions": {**package_versions("steadylight"), **backend.versions, **package_versions(*_INCIDENTAL)},
        "host": describe_host(),
    }
    # A JSON round trip, so that it compares equal to the content of the file.
    return dict(json.loads(json.dumps(content)))


def _plain_camera(camera: CameraPath) -> dict[str, Any]:
    return dict(json.loads(json.dumps(dataclasses.asdict(camera))))


def describe_survey(survey: Survey) -> dict[str, Any]:
    """Content of `run.json` under `survey`, for a cache in parts."""
    return dict(json.loads(json.dumps(dataclasses.asdict(survey))))


def read_run(directory: RunDirectory) -> RunRecord:
    """Read and check the `run.json` of a run directory.

    Raises:
        SettingsError: the file is missing, not readable, or has an unsupported format.
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
            f"{directory.run_file}: is not a run of this version of steadylight ({error})"
        ) from None


def _survey(content: Mapping[str, Any]) -> Survey:
    windows, neighbours = (
        tuple(tuple(int(part) for part in parts) for parts in content[name])
        for name in ("windows", "neighbours")
    )
    return Survey(windows, neighbours, dict(content["details"]))


def load_run(directory: RunDirectory) -> dict[str, Any]:
    """The plain content of `run.json`, after checking its format.

    Raises:
        SettingsError: the file is missing, not readable, or has another format.
    """
    content = directory.read_record()
    if content.get("format") not in _READABLE:
        raise SettingsError(
            f"{directory.run_file}: has run format {content.get('format')!r}; "
            f"this version of steadylight reads formats {' and '.join(map(str, _READABLE))}"
        )
    return content


def check_same_settings(
    directory: Path, then: Mapping[str, Any], scene: SceneDescription, settings: RenderSettings
) -> None:
    """Refuse to resume a run with other settings or another camera, before the scene is built and hashed.

    `check_same_run` makes the full comparison, for which the scene must be built.

    Args:
        directory: the run directory, for the message.
        then: content of its `run.json`.
        scene: scene of the current request.
        settings: settings of the current request.

    Raises:
        SettingsError: as in `check_same_run`.
    """
    if then["scene"]["name"] == scene.name:  # otherwise `check_same_run` reports the scene first
        lines = _setting_differences(_completed(then["settings"]), settings.model_dump(mode="json"))
        _refuse(directory, [*lines, *_camera_differences(then["camera"], _plain_camera(scene.camera))])


def check_same_run(directory: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to resume a run that was started with different input.

    The host and the location of the scene file are recorded but not compared: a run may move to another machine
    or working directory.

    Args:
        directory: the run directory, for the message.
        then: content of its `run.json`.
        now: `describe_run` of the current request.

    Raises:
        SettingsError: the message lists each difference, old and new.
    """
    _refuse(directory, list(_differences(then, now)))


def _refuse(directory: Path, differences: list[str]) -> None:
    """Raise SettingsError if there are differences."""
    if differences:
        raise SettingsError(
            f"{directory}: was started with different input:\n"
            + "\n".join(f"  {line}" for line in differences)
            + "\nRepeat the original command to resume, or choose another directory with --output."
        )


def _differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Each difference as a line: name, old value, new value."""
    before, here = _completed(then["settings"]), now["settings"]
    yield from _scene_differences(then["scene"], now["scene"])
    yield from _setting_differences(before, here)
    yield from _camera_differences(then["camera"], now["camera"])
    if then["camera"] == now["camera"] and then["selected"] != now["selected"] and before == here:
        yield f"selected frames: were {_short(then['selected'])}, are now {_short(now['selected'])}"
    if before["renderer"] != here["renderer"]:
        return  # the backend necessarily differs too
    if then["constants"] != now["constants"] and before == here:
        yield f"--quality {here['quality']}: was {then['constants']}, is now {now['constants']}"
    if then["variant"] != now["variant"]:
        yield f"--variant: was {then['variant']}, is now {now['variant']}"
    # If settings differ, a package that only one of the runs uses follows from them, and they are already listed.
    alike = before == here
    yield from _version_differences(then["versions"], now["versions"], whole=alike)


def _completed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run, with defaults for options that did not exist when it was started."""
    fields = RenderSettings.model_fields.items()
    return {name: field.default for name, field in fields if not field.is_required()} | dict(settings)


def _setting_differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    if (then["width"], then["height"]) != (now["width"], now["height"]):
        sizes = [f"{each['width']}x{each['height']}" for each in (then, now)]
        yield f"--size: was {sizes[0]}, is now {sizes[1]}"
    for name, value in now.items():
        if name not in {"width", "height"} and then[name] != value:
            yield f"{option_name(name)}: was {_short(then[name])}, is now {_short(value)}"


def _camera_differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    if then != now:
        yield "--camera: the camera path is different"


def _scene_differences(then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    if then["hash"] != now["hash"]:
        if then["name"] != now["name"]:
            yield f"scene: was {then['name']}, is now {now['name']}"
        else:
            yield f"scene: {now['name']} has changed (its content, its film, or a referenced file)"


def check_versions(directory: Path, versions: Mapping[str, str]) -> None:
    """Refuse to work on a run with other versions of the packages that determine its bytes.

    Args:
        directory: the run directory, for the message.
        versions: recorded versions of the run; programs are not Python packages and are not compared.

    Raises:
        BackendError: the message names each package with both versions.
    """
    here = package_versions(*(name for name in versions if name not in _INCIDENTAL))
    lines = [
        f"  {name}: is {here[name]} on this machine, {version} in the run"
        for name, version in versions.items()
        if here.get(name, "not installed") not in {version, "not installed"}
    ]
    if lines:
        raise BackendError(
            f"{directory}: was started with other versions, whose frames would not match:\n"
            + "\n".join(lines)
            + "\nInstall these versions on this machine."
        )


def _version_differences(then: Mapping[str, str], now: Mapping[str, str], *, whole: bool) -> Iterator[str]:
    """Version differences; with `whole`, also of packages that only one of the two has."""
    for name in {**then, **now}:
        in_both = name in then and name in now
        if name not in _INCIDENTAL and (in_both or whole) and then.get(name) != now.get(name):
            yield (
                f"{name}: was version {then.get(name)}, is now {now.get(name)} "
                "(new frames would not match the earlier ones)"
            )


def _short(value: object) -> str:
    """A value for a message; long lists are shortened to first item, last item and length."""
    if isinstance(value, list | tuple):
        if len(value) > 6:
            return f"{value[0]} … {value[-1]} ({len(value)} items)"
        return ", ".join(str(item) for item in value)
    return str(value)


def package_versions(*packages: str) -> dict[str, str]:
    """Versions of packages, and of `python`, without importing them."""
    versions = {}
    for package in packages:
        try:
            versions[package] = platform.python_version() if package == "python" else version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def describe_host() -> dict[str, Any]:
    """Processor and instruction sets, as far as the system reports them: they affect the last bits of a frame."""
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

"""What made the bytes: the record in `run.json`, and whether a run directory may be gone on with."""

from __future__ import annotations

import dataclasses
import json
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from steadylight.animation.plan import windows_of
from steadylight.cache.partition import Partition
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, SettingsError
from steadylight.settings import RenderSettings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pydantic import BaseModel

    from steadylight.scenes.description import SceneDescription
    from steadylight.storage import RunDirectory

FORMAT: Final = 1
"""Of `run.json`; raised when an older steadylight could misread it."""

_PACKAGES = ("steadylight", "mitsuba", "drjit", "numpy")
_DENOISER = "pyoidn"  # recorded only where it makes bytes
# Others bring small numerical changes at most.
_DECIDING_PACKAGES = ("steadylight", "mitsuba", "drjit", _DENOISER)
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
        variant: Mitsuba variant, `llvm_ad_rgb` or `cuda_ad_rgb`.
        selected: numbers of the first pass's frames.
        partition: of the cache.
        versions: of the packages that made the bytes, and of Python.
        host: processor and its instruction sets.
    """

    settings: RenderSettings
    scene_name: str
    scene_hash: str
    source: str
    camera: CameraPath
    variant: str
    selected: tuple[int, ...]
    partition: Partition
    versions: Mapping[str, str]
    host: Mapping[str, Any]


def describe_run(
    settings: RenderSettings, scene: SceneDescription, source: str, selected: Sequence[int], variant: str
) -> dict[str, Any]:
    """The content of `run.json`: all that decides the bytes, as plain data; `partition` comes to it after the survey.

    Args:
        settings: of the run.
        scene: with the camera path that the frames follow.
        source: name or file that the scene came from, as the user gave it.
        selected: numbers of the first pass's frames.
        variant: Mitsuba variant.
    """
    from steadylight.renderers.mitsuba.quality import quality_of

    content = {
        "format": FORMAT,
        "settings": settings.model_dump(mode="json"),
        "cache": dataclasses.asdict(quality_of(settings)),
        "selected": list(selected),
        "scene": {"name": scene.name, "hash": scene.hash, "source": source},
        "camera": dataclasses.asdict(scene.camera),
        "variant": variant,
        "versions": package_versions(denoise=settings.denoise),
        "host": describe_host(),
    }
    # Through JSON and back, so that it compares equal with what is read from the file.
    return dict(json.loads(json.dumps(content)))


def read_run(directory: RunDirectory) -> RunRecord:
    """Read and check the `run.json` of a run directory.

    Raises:
        SettingsError: not there, not readable, or of another format.
    """
    content = load_run(directory)
    try:
        camera = content["camera"]
        settings = RenderSettings.checked(**content["settings"])
        partition = Partition.whole(len(windows_of(settings.frames)))
        if settings.cache_parts > 1:
            partition = Partition.from_plain(content["partition"])
        return RunRecord(
            settings=settings,
            scene_name=content["scene"]["name"],
            scene_hash=content["scene"]["hash"],
            source=content["scene"]["source"],
            camera=CameraPath(tuple(Keyframe(**key) for key in camera["keyframes"]), camera["loop"]),
            variant=content["variant"],
            selected=tuple(content["selected"]),
            partition=partition,
            versions=content["versions"],
            host=content["host"],
        )
    except (KeyError, TypeError, ValueError, SettingsError, CameraError) as error:
        raise SettingsError(
            f"{directory.run_file}: does not describe a run of this steadylight ({error})"
        ) from None


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
    # A run of before there was such an option is as if it had been left out.
    then = {**then, "settings": _completed(then["settings"], RenderSettings)}
    yield from _scene_differences(then["scene"], now["scene"])
    for name, value in now["settings"].items():
        before = then["settings"][name]
        if before != value:
            yield f"--{name.replace('_', '-')}: {_short(before)} there, {_short(value)} here"
    quality = now["settings"]["quality"]
    chosen = all(then["settings"][name] == now["settings"][name] for name in ("quality", "radii"))
    if then["cache"] != now["cache"] and chosen:
        yield f"--quality {quality} stood for {then['cache']}, now for {now['cache']}"
    if then["camera"] != now["camera"]:
        yield "--camera: the camera path is another one"
    elif then["selected"] != now["selected"] and then["settings"] == now["settings"]:
        yield f"selected frames: {_short(then['selected'])} there, {_short(now['selected'])} here"
    if then["variant"] != now["variant"]:
        yield f"--variant: {then['variant']} there, {now['variant']} here"
    yield from _version_differences(then["versions"], now["versions"])


def _completed(values: Mapping[str, Any], kind: type[BaseModel]) -> dict[str, Any]:
    """Settings with what they do not name, as it was before it had a name: by its default, but for the radii."""
    defaults = {name: field.default for name, field in kind.model_fields.items() if not field.is_required()}
    return {**defaults, "radii": "split-sphere", **values}


def _scene_differences(then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    if then["hash"] != now["hash"]:
        if then["name"] != now["name"]:
            yield f"scene: {then['name']} there, {now['name']} here"
        else:
            yield f"scene: {now['name']} has changed since (content, film, or a file that it names)"


def _version_differences(then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    for package in _DECIDING_PACKAGES:
        if package == _DENOISER and not (package in then and package in now):
            continue  # that --denoise differs was said
        if then.get(package) != now.get(package):
            yield (
                f"{package}: version {then.get(package)} there, {now.get(package)} here "
                "(its frames would not match the earlier ones)"
            )


def _short(value: object) -> str:
    """A value for a message; long lists as their first, last and number."""
    if isinstance(value, list | tuple):
        if len(value) > 6:
            return f"{value[0]} … {value[-1]} ({len(value)} of them)"
        return ", ".join(str(item) for item in value)
    return str(value)


def package_versions(*, denoise: bool = False) -> dict[str, str]:
    """Versions of what makes the bytes, without importing it; with `denoise` that of the denoiser too."""
    versions = {}
    for package in (*_PACKAGES, *([_DENOISER] if denoise else [])):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {**versions, "python": platform.python_version()}


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

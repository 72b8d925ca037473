"""Mitsuba behind the renderer interface: the files that tasks read and write, and what stays loaded between tasks.

Importing this module is cheap: Mitsuba itself is imported when a scene is checked or opened.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.file import (
    CacheFile,
    encode_arrays,
    encode_cache,
    encode_points,
    read_arrays,
    read_cache,
    read_points,
)
from steadylight.cache.lookup import extrapolated, pair_weights
from steadylight.cache.merge import canonical_order, merge_caches
from steadylight.cache.partition import Partition, concatenate_parts, merge_part, smooth_part
from steadylight.cache.records import Floats, Records
from steadylight.errors import CacheFileError, RunError
from steadylight.renderers.base import (
    Backend,
    Box,
    Capabilities,
    Counts,
    Frame,
    Geometry,
    Job,
    Question,
    RecordTable,
    Renderer,
    SceneRenderer,
    Surfaces,
    Survey,
)
from steadylight.renderers.mitsuba.quality import quality_of
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

if TYPE_CHECKING:
    from steadylight.renderers.mitsuba import renderer as kernels
    from steadylight.renderers.mitsuba.records.filling import Points
    from steadylight.renderers.mitsuba.records.lookup import PartedCache

AUDIT_ROUNDS: Final = 2
"""Rounds in which all frames are searched for points that the cache does not cover; the last follows all paths."""

_CACHE, _MISSES, _PREPARED = ".safetensors", ".points", ".prepared"


class MitsubaCacheFiles:
    """Cache files for `steadylight cache`; format: docs/cache-file.md."""

    def describe(self, path: Path) -> Mapping[str, str]:
        """Number of records, scene, bounds, radii and mean irradiance of a cache, and the notes of its maker."""
        cache = read_cache(path)
        records = cache.records
        lines = {"records": f"{len(records):,}", "scene": cache.scene_hash}
        if len(records):
            low, high = records.position.min(axis=0), records.position.max(axis=0)
            radius = np.sort(records.radius)
            lines["bounds"] = f"{_vector(low)} to {_vector(high)} m"
            lines["radius"] = (
                f"{radius[0]:.4g} to {radius[-1]:.4g} m, median {radius[len(radius) // 2]:.4g} m"
            )
            lines["mean irradiance"] = f"{_vector(records.irradiance.sum(axis=1).mean(axis=0))} W/m²"
        return lines | {str(key): json.dumps(value) for key, value in cache.about.items()}

    def merge(self, paths: Sequence[Path], output: Path) -> Counts:
        """Merge caches of one scene, without duplicates.

        Raises:
            CacheFileError: a file cannot be read, or was made for another scene than the first.
        """
        caches = [read_cache(path) for path in paths]
        scene_hash = caches[0].scene_hash
        for path, cache in zip(paths, caches, strict=True):
            if cache.scene_hash != scene_hash:
                raise CacheFileError(
                    f"{path}: made for another scene (hash {cache.scene_hash[:12]}) than {paths[0]} (hash "
                    f"{scene_hash[:12]}); merge caches of one scene only"
                )
        records = merge_caches([cache.records for cache in caches])
        about = {"merged": [path.name for path in paths]}
        output.write_bytes(encode_cache(CacheFile(records, scene_hash, about)))
        return {"records_in": sum(len(cache.records) for cache in caches), "records_out": len(records)}

    def differences(self, path: Path, other: Path) -> tuple[bool, Mapping[str, str]]:
        """Whether two files hold the same records in any order, and the largest difference of each quantity."""
        a, b = read_cache(path), read_cache(other)
        lines = {"records": f"{len(a.records):,} and {len(b.records):,}"}
        lines["scene"] = "the same" if a.scene_hash == b.scene_hash else "another"
        first, second = (cache.records.take(canonical_order(cache.records)) for cache in (a, b))
        same = a.scene_hash == b.scene_hash and len(first) == len(second)
        for name in first.SHAPES if len(first) == len(second) else ():
            gap = np.abs(getattr(first, name).astype(np.float64) - getattr(second, name))
            largest = float(gap.max(initial=0.0))
            lines[f"largest difference of {name}"] = f"{largest:.6g}"
            same = same and largest == 0.0
        return same, lines


def _question(position: Floats, normal: Floats, records: Records) -> Question:
    """The records that contribute at a point, and their values."""
    weight = pair_weights(position, normal, records)
    rows = np.flatnonzero(weight)
    share = weight[rows] / records.radius[rows] ** 2
    rows = rows[np.argsort(-share, kind="stable")]
    share = np.sort(share)[::-1] / max(float(share.sum()), np.finfo(np.float32).tiny)
    value = np.maximum(extrapolated(position, normal, records, rows), 0).sum(axis=-2)
    distance = np.linalg.norm(position - records.position[rows], axis=1)
    return Question(
        position=_three(position),
        normal=_three(normal),
        irradiance=_three(share @ value),
        rows=tuple(map(int, rows)),
        distance=tuple(map(float, distance)),
        weight=tuple(map(float, weight[rows])),
        share=tuple(map(float, share)),
        value=tuple(map(_three, value)),
    )


def _three(values: NDArray[np.floating[Any]]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _vector(values: NDArray[np.floating[Any]]) -> str:
    """Numbers as `(x, y, z)`."""
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


class MitsubaScene:
    """One scene for the tasks of a worker; built when the first task needs it."""

    def __init__(self, job: Job, threads: int | None) -> None:
        """Keep the job; nothing is built yet."""
        self._job = job
        self._threads = threads
        self._partition = partition_of(job.survey)
        self._rounds = 1 if job.settings.first_pass == "surface" else AUDIT_ROUNDS
        self._prepared: Path | None = None
        self._loaded: dict[tuple[str, int], PartedCache] = {}

    @cached_property
    def _renderer(self) -> kernels.Renderer:
        from steadylight.renderers.mitsuba.backend import use_variant

        use_variant(self._job.variant, threads=self._threads)
        from steadylight.renderers.mitsuba import renderer as kernels

        return kernels.Renderer(self._job.scene, self._job.poses, self._job.settings, self._partition)

    def prepare(self, output: Path) -> Counts:
        """Make the secondary cache, and the emitter table that guides the gather."""
        renderer, start = self._renderer, time.perf_counter()
        prepared = renderer.prepare()
        output.write_bytes(encode_arrays(prepared.arrays(), self._job.scene.hash))
        return {"seconds": time.perf_counter() - start}

    def use(self, prepared: Path) -> None:
        """Load what `prepare` made, once."""
        if self._prepared != prepared:
            from steadylight.renderers.mitsuba.coverage import Prepared

            arrays = read_arrays(prepared, scene_hash=self._job.scene.hash)
            self._renderer.use(Prepared.of_arrays(arrays))
            self._prepared = prepared

    def look(self, frames: Sequence[int], output: Path) -> Counts:
        """Note the look-up points of some frames."""
        renderer, start = self._renderer, time.perf_counter()
        found = renderer.look(frames)
        output.write_bytes(encode_points(*found.points, self._job.scene.hash))
        return {"rays": found.looked_up, "seconds": time.perf_counter() - start}

    def gather_box(self, seen: Mapping[int, Path], box: Box, output: Path) -> Counts:
        """Make the records of a box."""
        renderer, start = self._renderer, time.perf_counter()
        found = self._points(seen, box.part)
        records, points = renderer.fill_box(found, box)
        self._write(output, records)
        return {
            "hits": points - len(records),
            "misses": len(records),
            "records": len(records),
            "seconds": time.perf_counter() - start,
        }

    def gather(self, frame: int, output: Path) -> Counts:
        """First pass: trace Sobol' pixels of a frame until enough of them hit."""
        renderer, start = self._renderer, time.perf_counter()
        # Without the audit, nobody would fill what frames leave to each other, so each works alone, as published.
        shared = self._job.selected if self._job.settings.coverage == "full" else ()
        done = renderer.first_pass(frame, shared)
        self._write(output, done.records)
        return {
            "rays": done.rays,
            "hits": done.hits,
            "misses": done.misses,
            "left": done.left,
            "records": len(done.records),
            "seconds": time.perf_counter() - start,
        }

    def merge(self, caches: Sequence[Path], part: int, output: Path) -> Counts:
        """Merge first-pass caches into one, or into a part of it."""
        gathered = [self._read(path) for path in caches]
        merged = merge_part(gathered, self._partition, part)
        self._write(output, merged)
        own = (np.count_nonzero(self._partition.part_of(cache.position) == part) for cache in gathered)
        return {"records_in": int(sum(own)), "records_out": len(merged)}

    def audit(self, frames: Sequence[int], caches: Sequence[Path], audit_round: int, output: Path) -> Counts:
        """Note the points along some frames that no record covers; the last round follows every path."""
        renderer, cache = self._renderer, self._load("audit", audit_round, caches)
        start = time.perf_counter()
        found = renderer.audit(frames, cache, last=audit_round == self._rounds)
        output.write_bytes(encode_points(*found.points, self._job.scene.hash))
        return {
            "looked_up": found.looked_up,
            "missed": found.missed,
            "seconds": time.perf_counter() - start,
        }

    def fill(
        self, cache: Path, misses: Mapping[int, Path], part: int, audit_round: int, output: Path
    ) -> Counts:
        """Add records to a part at the audit's misses."""
        renderer, start = self._renderer, time.perf_counter()
        before = self._read(cache)
        found = self._points(misses, part)
        if self._job.settings.first_pass == "surface":
            found = [renderer.worth_records(found, before, self._samples(misses))]
        after = renderer.fill(found, before, audit_round, part)
        self._write(output, after)
        return {"records": len(after) - len(before), "seconds": time.perf_counter() - start}

    def smooth(self, cache: Path, around: Sequence[Path], output: Path) -> Counts:
        """Average the records of a part with their neighbours."""
        records = self._smoothed(cache, around)
        self._write(output, records)
        return {}

    def smooth_and_stretch(
        self, cache: Path, around: Sequence[Path], misses: Mapping[int, Path], part: int, output: Path
    ) -> Counts:
        """Smooth a part, then stretch records to serve all look-ups that it still misses."""
        records = self._smoothed(cache, around)
        records, count = self._renderer.stretch(self._points(misses, part), records)
        self._write(output, records)
        return {"stretched": count}

    def _smoothed(self, cache: Path, around: Sequence[Path]) -> Records:
        others = [self._read(path) for path in around]
        smoothing = quality_of(self._job.settings).smoothing
        return smooth_part(self._read(cache), others, self._partition.radius, smoothing)

    def concatenate(self, caches: Sequence[Path], output: Path) -> Counts:
        """Write all parts to one file."""
        self._write(output, concatenate_parts([self._read(path) for path in caches]))
        return {}

    def shade(self, frame: int, caches: Sequence[Path] | None) -> Frame:
        """Render a frame from the shared cache, or from a private one."""
        renderer = self._renderer
        cache = None if caches is None else self._load("shade", 0, caches)
        start = time.perf_counter()
        done = renderer.shade(frame, cache)
        return dataclasses.replace(done, seconds=time.perf_counter() - start)

    def trace(self, frame: int) -> Frame:
        """Render a frame with Mitsuba's path tracer."""
        renderer, start = self._renderer, time.perf_counter()
        return Frame(renderer.path(frame).image, seconds=time.perf_counter() - start)

    def surfaces(self, frame: int) -> Surfaces:
        """The surface that each pixel of a frame sees."""
        return self._renderer.surfaces(frame)

    def records(self, caches: Sequence[Path]) -> RecordTable:
        """The records of some files, for display."""
        parts = [self._read(path) for path in caches]
        records = Records.concatenate(*parts)
        irradiance = records.irradiance.sum(axis=1)
        mean = irradiance.mean(axis=1)
        error = np.sqrt(np.square(records.standard_error).sum(axis=1))
        return RecordTable(
            records.position,
            records.normal,
            records.radius,
            irradiance,
            np.where(mean > 0, error / np.where(mean > 0, mean, 1), np.nan).astype(np.float32),
            np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
        )

    def questions(self, frame: int, pixel: tuple[int, int], caches: Sequence[Path]) -> Sequence[Question]:
        """Cache look-ups through the centre of a pixel, evaluated by the NumPy twin of the look-up."""
        position, normal = self._renderer.asked(frame, pixel)
        records = Records.concatenate(*(self._read(path) for path in caches))
        return [_question(p, n, records) for p, n in zip(position, normal, strict=True)]

    def _points(self, noted: Mapping[int, Path], part: int) -> list[Points]:
        """The points of a file per window that lie in a part of the cache, by window."""
        from steadylight.renderers.mitsuba.records.filling import Points

        found = []
        for window, path in noted.items():
            points = Points(*read_points(path, scene_hash=self._job.scene.hash))
            own = self._partition.owner_of(points.position, self._partition.windows[window]) == part
            found.append(points.take(own))
        return found

    def _samples(self, windows: Iterable[int]) -> int:
        """Camera samples of some windows, each divided by the number of parts that the window reads."""
        s = self._job.settings
        pixels = s.width * s.height * s.spp
        return int(sum(pixels * len(self._job.windows[n]) / len(self._partition.windows[n]) for n in windows))

    def _read(self, path: Path) -> Records:
        return read_cache(path, scene_hash=self._job.scene.hash).records

    def _write(self, output: Path, records: Records) -> None:
        """Write a cache file.

        Raises:
            RunError: a value is not finite; one such record would spoil every look-up that interpolates it.
        """
        arrays = (getattr(records, field) for field in Records.SHAPES)
        bad = sum(int(np.count_nonzero(~np.isfinite(array))) for array in arrays)
        bad -= int(np.count_nonzero(np.isposinf(records.headroom)))  # nothing overhead
        if bad:
            raise RunError(
                f"records came out with {bad} values that are not finite, which is a fault of the renderer: please "
                "report it together with the scene; another --seed may get past it"
            )
        output.write_bytes(encode_cache(CacheFile(records, self._job.scene.hash, {})))

    def _load(self, stage: str, audit_round: int, paths: Sequence[Path]) -> PartedCache:
        """The cache that a task reads, on the device.

        Parts that earlier tasks of the same pass loaded stay loaded, since later tasks read much the same; but only the
        parts that this task names take part in look-ups.
        """
        names = [str(path) for path in paths]
        cache = self._loaded.get((stage, audit_round))
        lacking = [path for path in paths if cache is None or str(path) not in cache.names]
        if cache is None or lacking:
            if self._partition.count == 1:
                self._loaded.clear()  # an earlier round is never read again
            parts = {str(path): self._read(path) for path in lacking}
            cache = self._renderer.load(parts) if cache is None else cache.with_parts(parts)
            self._loaded[stage, audit_round] = cache
        cache.show(names)
        return cache


class MitsubaRenderer:
    """The irradiance cache on Mitsuba 3 and Dr.Jit."""

    name = "mitsuba"
    capabilities = Capabilities(
        scenes=("mitsuba",),
        modes=("two-pass", "single-pass", "path"),
        audit_rounds=AUDIT_ROUNDS,
        surfaces=True,
        prepares=True,
        prepared_suffix=_PREPARED,
        parts=True,
        smoothing=True,
        denoising=True,
        inspection=True,
        probing=True,
        cache_suffix=_CACHE,
        misses_suffix=_MISSES,
    )
    cache_files = MitsubaCacheFiles()

    def check(
        self, scene: SceneDescription, settings: RenderSettings, variant: str, *, build: bool
    ) -> Backend:
        """Check that backend, denoiser and scene are usable here."""
        from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant

        resolved = resolve_variant(variant)
        if settings.denoise:
            from steadylight.renderers.mitsuba.image.denoising import check_denoiser

            check_denoiser()
        if build:
            use_variant(resolved)
            from steadylight.renderers.mitsuba.scene import check_scene

            check_scene(scene)
        # Other packages cause small numerical changes at most.
        packages = ("mitsuba", "drjit", *(["pyoidn"] if settings.denoise else []))
        return Backend(
            resolved, {name: _version(name) for name in packages}, dataclasses.asdict(quality_of(settings))
        )

    def survey(self, job: Job) -> Survey:
        """Find the surfaces that the frames see, and divide space into parts of about equal work."""
        from steadylight.renderers.mitsuba.backend import use_variant

        use_variant(job.variant)
        from steadylight.renderers.mitsuba.survey import survey

        windows = [[job.poses[frame] for frame in window] for window in job.windows]
        return survey_of(survey(job.scene, windows, job.settings))

    def geometry(self, scene: SceneDescription, variant: str) -> Geometry:
        """The surfaces of a scene, through Mitsuba's ray intersection."""
        from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant

        use_variant(resolve_variant(variant))
        from steadylight.renderers.mitsuba.geometry import MitsubaGeometry

        return MitsubaGeometry(scene)

    def probe(self, job: Job) -> float | None:
        """Time some paths and estimate how many records the film needs; not on a GPU."""
        from steadylight.renderers.mitsuba.backend import use_variant

        if not job.variant.startswith("llvm"):
            return None
        use_variant(job.variant)
        from steadylight.renderers.mitsuba.probe import probed_seconds

        return probed_seconds(job.scene, [job.poses[frame] for frame in job.settings.frames], job.settings)

    def validate(self, path: Path, scene_hash: str) -> None:
        """Read a file back and verify its checksum."""
        if path.suffix == _PREPARED:
            read_arrays(path, scene_hash=scene_hash)
        elif path.suffix == _MISSES:
            read_points(path, scene_hash=scene_hash)
        else:
            read_cache(path, scene_hash=scene_hash)

    def open(self, job: Job, threads: int | None) -> SceneRenderer:
        """Keep the job; the scene is built when a task needs it."""
        return MitsubaScene(job, threads)

    def release(self) -> None:
        """Let go of the scene that was built last."""
        from steadylight.renderers.mitsuba.scene import release

        release()


def survey_of(partition: Partition) -> Survey:
    """The parts of the cache as the plan sees them; their boxes, which the plan does not use, go into the details."""
    parts = range(partition.count)
    neighbours = tuple(tuple(n for n in partition.around([part]) if n != part) for part in parts)
    details = partition.plain()
    del details["windows"]
    return Survey(partition.windows, neighbours, details)


def partition_of(survey: Survey) -> Partition:
    """Inverse of `survey_of`; an undivided cache has no details."""
    if not survey.details:
        return dataclasses.replace(Partition.whole(0), windows=survey.windows)
    return Partition.from_plain({**survey.details, "windows": survey.windows})


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


RENDERER: Final[Renderer] = MitsubaRenderer()

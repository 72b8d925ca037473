"""The two passes on one scene, with Radiance's `rtrace`.

Each call of the program gets an ambient file of its own in a temporary folder. The program reads it and appends to it;
the records that it appended are those that the cache lacked. It runs on one core and starts with the same random seed
each time, so the same call on the same file gives the same bytes.

The audit ensures that no frame of the second pass needs a record of its own. The surface points that a frame's rays hit
do not depend on random numbers: rays go through the centres of pixels, and rough gloss is not sampled
(`quality.WORKING`). The first round of the audit traces all these rays, so that a record is made wherever one is
missing. Later rounds render the frame and check that it needs no further record. Such a frame is *clean*. It remains
clean when records are added, because these never turn a hit into a miss. Later rounds skip clean frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import CacheFileError
from steadylight.renderers.base import Counts, Frame, Job
from steadylight.renderers.radiance.ambient import (
    AmbientFile,
    Origin,
    Records,
    concatenated,
    encode_ambient,
    moved_off,
    read_ambient,
)
from steadylight.renderers.radiance.merging import thinned, united
from steadylight.renderers.radiance.picture import filtered
from steadylight.renderers.radiance.quality import Options
from steadylight.renderers.radiance.view import View, is_mirrored
from steadylight.renderers.radiance.workplace import Workplace
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.radiance.programs import output_of, version

GROWTH: Final = 1.5
"""Factor by which the number of rays of the first pass grows between two checks of hits and misses."""

BAND: Final = 1 << 20
"""Maximum number of samples per process when all samples of a frame are taken; at least one row is taken."""

TRIES: Final = 3
"""Maximum number of times that a round of the audit, after the first, renders a frame. Each time uses the records of
the times before."""

_OCTREE: Final = "scene.oct"


class _Octree(NamedTuple):
    """A scene in the form that the programs read.

    Attributes:
        folder: contains the octree and all that it refers to.
        digest: of the octree.
        sky: whether there is light from a `glow` all around.
    """

    folder: Path
    digest: str
    sky: bool


class ScenePasses:
    """One scene for the tasks of a worker; its octree is made when the first task needs it."""

    def __init__(self, job: Job) -> None:
        """Keep the job; nothing is made yet."""
        self._job = job
        self._size = (job.settings.width, job.settings.height)
        self._place = Workplace()

    def gather(self, frame: int, output: Path) -> Counts:
        """First pass: trace pixels of a frame in Sobol' order with `rtrace`, until hits : misses reach the threshold.

        Aggarwal, Chalmers & Debattista 2008, section 3.2.1. The ratio is checked after the base rays, and then whenever
        their number has grown by half: each record of level 0 in the ambient file is a miss, and every other ray that
        hits a surface is a hit.
        """
        octree, settings = self._octree, self._job.settings
        start = time.perf_counter()
        pixels = self._sobol_pixels(frame)
        rays = View(self._job.poses[frame], *self._size).rays(pixels)
        sent = hits = misses = 0
        with self._folder() as folder:
            cache = folder / "cache.amb"
            while sent < len(rays):
                end = min(max(settings.base_rays, int(np.ceil(sent * GROWTH))), len(rays))
                met, new = self._send(octree, rays[sent:end], cache)
                missed = int(np.count_nonzero(new["level"] == 0))
                sent, misses, hits = end, misses + missed, hits + max(met - missed, 0)
                if sent >= settings.base_rays and hits >= settings.threshold * misses and hits:
                    break
            made = read_ambient(cache)
            self._write(output, made, united([moved_off(made.records)]))
        return {
            "rays": sent,
            "hits": hits,
            "misses": misses,
            "left": 0,
            "records": len(made.records),
            "seconds": time.perf_counter() - start,
        }

    def merge(self, caches: Sequence[Path], part: int, output: Path) -> Counts:
        """Merge caches of selected frames: the header of the first, the records of all except redundant ones."""
        assert part == 0
        gathered = [self._read(path) for path in caches]
        everything = concatenated([cache.records for cache in gathered])
        records = thinned(everything, self._options.ambient.accuracy)
        self._write(output, gathered[0], records)
        return {"records_in": len(everything), "records_out": len(records)}

    def audit(self, frames: Sequence[int], caches: Sequence[Path], audit_round: int, output: Path) -> Counts:
        """Make the records that the frames lack, in a copy of the cache; clean frames are skipped.

        The first round traces the frames' rays in random order; the others render exactly what the second pass will.
        """
        octree = self._octree
        start = time.perf_counter()
        (path,) = caches
        cache = self._read(path)
        clean = set(cache.clean)
        looked_up = missed = 0
        with self._folder() as folder:
            private = folder / "cache.amb"
            private.write_bytes(path.read_bytes())
            for frame in (frame for frame in frames if frame not in clean):
                for _ in range(1 if audit_round == 1 else TRIES):
                    probe = self._probe if audit_round == 1 else self._render
                    samples, new = self._growth(private, partial(probe, octree, frame, private))
                    looked_up += samples
                    missed += int(np.count_nonzero(new["level"] == 0))
                    if not len(new):
                        if audit_round > 1:
                            clean.add(frame)
                        break
            found = read_ambient(private).records[len(cache.records) :]
        self._write(output, cache, united([found]), clean & set(frames))
        return {"looked_up": looked_up, "missed": missed, "seconds": time.perf_counter() - start}

    def fill(
        self, cache: Path, misses: Mapping[int, Path], part: int, audit_round: int, output: Path
    ) -> Counts:
        """Add to the cache all records that the audits of a round made.

        Only duplicates are dropped, not redundant records as in `merge`: a frame may need each of them.
        """
        assert part == 0
        assert audit_round > 0
        before = self._read(cache)
        found = [self._read(path) for path in misses.values()]
        records = united([before.records, *(each.records for each in found)])
        self._write(output, before, records, before.clean.union(*(each.clean for each in found)))
        return {"records": len(records) - len(before.records)}

    def smooth(self, cache: Path, around: Sequence[Path], output: Path) -> Counts:  # noqa: ARG002 - never asked
        """Copy the cache: Radiance has no smoothing."""
        return self.concatenate([cache], output)

    def concatenate(self, caches: Sequence[Path], output: Path) -> Counts:
        """Copy the cache: it is never divided into parts."""
        (cache,) = caches
        output.write_bytes(cache.read_bytes())
        return {}

    def shade(self, frame: int, caches: Sequence[Path] | None) -> Frame:
        """Second pass: render a frame from a copy of the cache, or from an initially empty one (single-pass)."""
        octree = self._octree
        start = time.perf_counter()
        with self._folder() as folder:
            private, known = folder / "cache.amb", 0
            if caches is not None:
                (path,) = caches
                known = len(self._read(path).records)
                private.write_bytes(path.read_bytes())
            image = self._image(octree, frame, [*self._options.words(), "-af", str(private)])
            new = read_ambient(private).records[known:]
        missed = int(np.count_nonzero(new["level"] == 0))
        return Frame(self._filtered(image), missed, len(new), time.perf_counter() - start)

    def trace(self, frame: int) -> Frame:
        """Mode `path`: render a frame without a cache, with one ambient ray per reflection."""
        octree = self._octree
        start = time.perf_counter()
        image = self._image(octree, frame, self._options.words_without_cache())
        return Frame(self._filtered(image), seconds=time.perf_counter() - start)

    @cached_property
    def _octree(self) -> _Octree:
        """The scene in a folder of its own."""
        folder = self._place.folder / "scene"
        folder.mkdir()
        sky = write_octree(self._job.scene, folder)
        return _Octree(folder, sha256((folder / _OCTREE).read_bytes()).hexdigest()[:32], sky)

    @cached_property
    def _options(self) -> Options:
        return Options.of(self._job.settings, sky=self._octree.sky)

    @contextmanager
    def _folder(self) -> Iterator[Path]:
        """A temporary folder for one call."""
        with TemporaryDirectory(dir=self._place.folder) as folder:
            yield Path(folder)

    def _sobol_pixels(self, frame: int) -> NDArray[np.float64]:
        """Pixel centres in the order of a scrambled Sobol' set, (N, 2) in [0, 1)²; as many as there are pixels."""
        from scipy.stats import qmc  # importing it takes longer than `cache info`

        width, height = self._size
        sobol = qmc.Sobol(2, rng=np.random.default_rng([self._job.settings.seed, frame]))
        points = sobol.random_base2(int(np.ceil(np.log2(max(width * height, 2)))))[: width * height]
        size = np.array(self._size)
        middles: NDArray[np.float64] = (np.floor(points * size) + 0.5) / size
        return middles

    def _send(self, octree: _Octree, rays: NDArray[np.float64], cache: Path) -> tuple[int, Records]:
        """Trace rays with a cache; returns how many hit a surface, and the records that they added."""
        known = len(read_ambient(cache).records) if cache.exists() else 0
        seen = _traced(octree, rays, "-fdf", "-ovL", *self._options.words(), "-af", cache)
        far = np.frombuffer(seen, "<f4").reshape(len(rays), 4)[:, 3] > _FAR
        return int(np.count_nonzero(~far)), read_ambient(cache).records[known:]

    def _growth(self, cache: Path, look: Callable[[], int]) -> tuple[int, Records]:
        """Run `look` on a cache file; returns its number of samples, and the records it added, before `moved_off`.

        In the file, the added records are moved off.
        """
        before = read_ambient(cache)
        samples = look()
        new = read_ambient(cache).records[len(before.records) :]
        if len(new):
            together = concatenated([before.records, moved_off(new)])
            cache.write_bytes(encode_ambient(before.with_records(together)))
        return samples, new

    def _probe(self, octree: _Octree, frame: int, cache: Path) -> int:
        """Trace all rays of a frame, so that missing records are added to a cache; returns the number of rays.

        The order is random: row by row, each record would be made at the edge of the previous one.
        """
        samples = 0
        for band in self._bands(frame):
            self._send(octree, np.random.default_rng(len(band)).permutation(band), cache)
            samples += len(band)
        return samples

    def _render(self, octree: _Octree, frame: int, cache: Path) -> int:
        """Render a frame, so that missing records are added to a cache; returns the number of samples."""
        image = self._image(octree, frame, [*self._options.words(), "-af", str(cache)])
        return image.size // 3

    def _bands(self, frame: int) -> Iterator[NDArray[np.float64]]:
        """Rays of all samples of a frame from top to bottom, (N, 6), in batches of as many rows as fit in BAND.

        Each sample is taken at the centre of a pixel of a larger image.
        """
        k = self._options.oversampling
        width, height = (side * k for side in self._size)
        rows = max(1, BAND // width)
        view = View(self._job.poses[frame], *self._size)
        for top in range(0, height, rows):
            y, x = np.mgrid[top : min(top + rows, height), 0:width]
            yield view.rays((np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / [width, height])

    def _image(self, octree: _Octree, frame: int, options: Sequence[str]) -> NDArray[np.float32]:
        """All samples of a frame, (k height, k width, 3)."""
        width, height = (side * self._options.oversampling for side in self._size)
        seen = b"".join(_traced(octree, band, "-fdf", "-ov", *options) for band in self._bands(frame))
        return np.frombuffer(seen, "<f4").reshape(height, width, 3)

    def _filtered(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Filter the larger image down to a frame."""
        scene = self._job.scene
        image = image[:, ::-1] if is_mirrored(scene) else image
        return filtered(image, self._options.oversampling, scene.film)

    def _read(self, path: Path) -> AmbientFile:
        """Read a cache of this scene, made with the same options.

        Raises:
            CacheFileError: it is damaged, or of another scene or other options.
        """
        cache = read_ambient(path, scene_hash=self._job.scene.hash)
        if cache.origin != self._origin.line:
            raise CacheFileError(f"{path}: was made from another octree or with other options")
        return cache

    @cached_property
    def _origin(self) -> Origin:
        return Origin(
            self._job.scene.hash, self._octree.digest, " ".join([version(), *self._options.words()])
        )

    def _write(
        self,
        output: Path,
        like: AmbientFile,
        records: Records,
        clean: frozenset[int] | set[int] = frozenset(),
    ) -> None:
        """Write a cache with our header, which contains the options of the second pass."""
        header = list(like.header)
        header[1] = " ".join(["rtrace", *self._options.words(), _OCTREE])
        ours = replace(
            like, header=tuple(header), records=records, origin=self._origin.line, clean=frozenset(clean)
        )
        output.write_bytes(encode_ambient(ours))


_FAR: Final = 1e9
"""Distances beyond this are those that `rtrace` returns for rays that hit nothing, or a distant source."""


def _traced(octree: _Octree, rays: NDArray[np.float64], *options: object) -> bytes:
    """Output of `rtrace` for some rays.

    Raises:
        RunError: it failed; contains its error message.
    """
    given = np.ascontiguousarray(rays, "<f8").tobytes()
    return output_of(octree.folder, "rtrace", "-h", "-n", "1", *options, _OCTREE, given=given)


def write_octree(scene: SceneDescription, folder: Path) -> bool:
    """Write a scene as `scene.oct` into a folder; returns whether its sky is a `glow`.

    Raises:
        SceneError: Radiance has no counterpart for something in the scene.
    """
    if scene.format == "radiance":
        (folder / _OCTREE).write_bytes(scene.content["octree"].tobytes())
        for name, file in scene.content["files"].items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.symlink_to(file)
        return bool(scene.content["sky"])
    from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
    from steadylight.renderers.radiance.export import export

    use_variant(resolve_variant("llvm"))
    return export(scene, folder).sky

"""Makes the page that compares films: players side by side, differences, flicker, and measures of each frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.atomic_file import atomic_write
from steadylight.errors import InputError
from steadylight.images import exposure_of_files, luminance, read_exr, tone_map
from steadylight.metrics.blocks import Grid
from steadylight.metrics.reprojection import View, temporal_deviation, thinned, warp
from steadylight.metrics.still import flip, rel_rmse
from steadylight.report.costs import costs_of, rows_of
from steadylight.report.embedding import as_json, jpeg, page_from, resized, text
from steadylight.report.films import Film

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from steadylight.camera import Pose
    from steadylight.metrics.reprojection import Warp

PICTURE_BYTES = 13_000_000
"""Maximum size of the pictures of all films together; those of long films are scaled down. Base64 adds a third."""

FLICKER_BYTES = 4_000_000
"""The same for the flicker pictures."""

QUALITY = 90
"""JPEG quality: artefacts are invisible, and as each picture is compressed separately, they add no flicker."""

WIDEST = 800
"""Maximum width of a picture, pixels."""

FLICKER_WIDTH = 240
"""Maximum width of a flicker picture, pixels."""

FLICKER_FULL = 0.2
"""Temporal deviation that is drawn brightest."""

BLOCK_BYTES = 4_000_000
"""Maximum size of the brightness of all blocks of all films."""

FLIP_FRAMES = 60
"""Maximum number of frames, equally spaced, for which FLIP is measured: it takes a good part of a second each."""


@dataclass
class _Shown:
    """A film and its measures, frame by frame; None where a frame is missing."""

    film: Film
    pictures: list[str | None] = field(default_factory=list)
    flicker: list[str | None] = field(default_factory=list)
    deviation: list[float | None] = field(default_factory=list)
    sums: list[NDArray[np.float64] | None] = field(default_factory=list)
    rel_rmse: list[float | None] = field(default_factory=list)
    flip: list[float | None] = field(default_factory=list)


@dataclass(frozen=True)
class _Sizes:
    """Sizes of what the page holds."""

    picture: tuple[int, int]
    thinning: int
    grid: Grid

    @classmethod
    def of(cls, samples: Sequence[NDArray[np.uint8]], pictures: int) -> _Sizes:
        """Choose the sizes for a number of pictures, from some samples of them in full size."""
        height, width = samples[0].shape[:2]
        size = _fitted(samples, (width, height), PICTURE_BYTES / pictures)
        # Flicker is noise, which takes about half a byte a pixel.
        widest = min(FLICKER_WIDTH, size[0], math.sqrt(2 * FLICKER_BYTES / pictures * width / height))
        thinning = 1
        while width / thinning > widest:
            thinning += 2  # odd, so that the middle of a block is a pixel
        most = int(np.clip(BLOCK_BYTES / 4 / pictures, 48, 1500))
        return cls(size, thinning, Grid.of(width, height, most))


def _fitted(samples: Sequence[NDArray[np.uint8]], size: tuple[int, int], most: float) -> tuple[int, int]:
    """The largest size at which a picture takes at most `most` bytes, in the mean over some samples."""
    width, height = size
    scale = min(1.0, WIDEST / width)
    fitted = size
    for _ in range(4):  # a smaller picture has more detail in each pixel
        fitted = max(16, round(width * scale)), max(1, round(height * scale))
        found = np.mean([len(jpeg(resized(sample, *fitted), QUALITY)) for sample in samples])
        if found <= most:
            break
        scale *= 0.97 * math.sqrt(most / found)
    return fitted


def write_comparison(
    runs: Sequence[Path], output: Path, reference: Path | None = None, title: str = ""
) -> Path:
    """Write one page that compares runs; it needs no other file and no network.

    The page names what is missing or damaged in a run, and shows the rest. Frames are read one at a time.

    Args:
        runs: run directories, or folders of EXR files whose names end in the frame number.
        output: the page; an existing file is replaced.
        reference: another run, against which the errors are measured; the first run if None.
        title: title of the page; the name of the scene if empty.

    Returns:
        The path of the page.

    Raises:
        InputError: a folder is not a run, none has a frame, or their frames differ in size.
        StorageError: the page cannot be written.
    """
    films = _named_apart([Film.open(path) for path in runs])
    truth = films[0] if reference is None else Film.open(reference)
    numbers = sorted(set().union(*(film.frames for film in films)))
    if not numbers:
        raise InputError(
            f"{', '.join(str(f.path) for f in films)}: no frames yet; compare them once they have frames"
        )
    measured = _Comparison(films, truth, numbers)
    for number in numbers:
        measured.add(number)
    values = measured.data()
    page = page_from(
        "comparison.html",
        title=title or _title(films),
        films=[costs_of(film, truth, output.parent) for film in films],
        columns=rows_of(films),
        notices=[
            *dict.fromkeys(notice for film in (*films, truth) for notice in film.notices),
            *measured.notices,
        ],
        reference=truth.name,
        data=as_json(values),
    )
    with atomic_write(output) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return output


def _named_apart(films: Sequence[Film]) -> list[Film]:
    """The films with unique names: those with the same folder name get their path as name."""
    names = [film.name for film in films]
    return [replace(film, name=str(film.path)) if names.count(film.name) > 1 else film for film in films]


class _Comparison:
    """Measures films frame by frame."""

    def __init__(self, films: Sequence[Film], truth: Film, numbers: Sequence[int]) -> None:
        self.films, self.truth, self.numbers = films, truth, numbers
        self.notices: list[str] = []
        source = truth if truth.frames else next(film for film in films if film.frames)
        self.shape, self.first, self.exposure = self._scale(source)
        samples = [tone_map(read_exr(path), self.exposure) for film in films for path in film.readable(4)]
        if not samples:
            raise InputError(
                f"{', '.join(str(film.path) for film in films)}: no frame can be read; render again"
            )
        self.sizes = _Sizes.of(samples, sum(len(film.frames) for film in films))
        self.shown = [_Shown(film) for film in films]
        compared = [n for n in numbers if n in truth.frames]
        steps = np.linspace(0, len(compared) - 1, min(FLIP_FRAMES, len(compared))).round().astype(int)
        self.flipped = {compared[step] for step in steps}
        self.views = _Views([*films, truth], self.shape, self.sizes.thinning)
        if self.views.why_not:
            self.notices.append(self.views.why_not)
        self.before: dict[int, NDArray[np.floating]] = {}
        self.before_number: int | None = None

    def _scale(self, source: Film) -> tuple[tuple[int, ...], Path, float]:
        """Shape of the frames, path of a frame that has it, and the exposure of all films."""
        readable = list(source.readable(16))
        if not readable:
            raise InputError(f"{source.path}: none of its frames can be read; render it again")
        return read_exr(readable[0]).shape, readable[0], exposure_of_files(readable)

    def add(self, number: int) -> None:
        """Measure one frame of each film."""
        truth = self._read(self.truth, number)
        warped, known = self.views.step(self.before_number, number)
        light: dict[int, NDArray[np.floating]] = {}
        for index, shown in enumerate(self.shown):
            image = truth if shown.film is self.truth else self._read(shown.film, number)
            if image is None:
                for series in (
                    shown.pictures,
                    shown.flicker,
                    shown.deviation,
                    shown.sums,
                    shown.rel_rmse,
                    shown.flip,
                ):
                    series.append(None)
                continue
            shown.pictures.append(
                text(jpeg(resized(tone_map(image, self.exposure), *self.sizes.picture), QUALITY))
            )
            shown.sums.append(self.sizes.grid.sums(image))
            self._errors(shown, number, image, truth)
            light[index] = thinned(luminance(image), self.sizes.thinning)
            self._flicker(shown, light[index], self.before.get(index) if known else None, warped)
        self.before, self.before_number = light, number

    def _errors(
        self, shown: _Shown, number: int, image: NDArray[np.float32], truth: NDArray[np.float32] | None
    ) -> None:
        compared = truth is not None and shown.film is not self.truth
        shown.rel_rmse.append(_plain(rel_rmse(image, truth)) if compared and truth is not None else None)
        seen = compared and number in self.flipped
        shown.flip.append(_plain(flip(image, truth, self.exposure)) if seen and truth is not None else None)

    def _flicker(
        self,
        shown: _Shown,
        light: NDArray[np.floating],
        before: NDArray[np.floating] | None,
        warped: Warp | None,
    ) -> None:
        if before is None:
            shown.flicker.append(None)
            shown.deviation.append(None)
            return
        deviation = temporal_deviation(light, before, warped)
        known = np.ones(deviation.shape, bool) if warped is None else warped.known
        shown.deviation.append(_plain(float(deviation[known].mean())) if known.any() else None)
        drawn = np.clip(deviation / FLICKER_FULL * 255, 0, 255).astype(np.uint8)
        shown.flicker.append(text(jpeg(drawn, QUALITY)))

    def _read(self, film: Film, number: int) -> NDArray[np.float32] | None:
        """A frame; None, with a notice, if it is missing or damaged."""
        image = film.frame(number)
        if image is not None and image.shape != self.shape:
            found, right = (f"{shape[1]}x{shape[0]}" for shape in (image.shape, self.shape))
            raise InputError(
                f"{film.frames[number]}: is {found} pixels, but {self.first} is {right}; sizes must match"
            )
        return image

    def data(self) -> dict[str, Any]:
        """The data for the script of the page."""
        grid = self.sizes.grid
        rates = [film.fps for film in self.films if film.fps]
        return {
            "numbers": list(self.numbers),
            "fps": rates[0] if rates else 25,
            "size": list(self.sizes.picture),
            "grid": {
                "columns": grid.columns,
                "rows": grid.rows,
                "block": grid.block,
                "size": [grid.width, grid.height],
            },
            "flickerFull": FLICKER_FULL,
            "runs": [
                {
                    "name": shown.film.name,
                    "pictures": shown.pictures,
                    "flicker": shown.flicker if any(shown.flicker) else None,
                    "sums": text(_packed(shown.sums, grid)),
                    "measures": {
                        name: series
                        for name, series in (
                            ("temporal deviation", shown.deviation),
                            ("rel_rmse", shown.rel_rmse),
                            ("FLIP", shown.flip),
                        )
                        if any(value is not None for value in series)
                    },
                }
                for shown in self.shown
            ],
        }


class _Views:
    """What pixels see, frame by frame, from whichever film has AOVs: films of one scene and camera see the same.

    Attributes:
        why_not: why there are no flicker pictures, as a sentence; empty if there are.
    """

    def __init__(self, films: Sequence[Film], shape: tuple[int, ...], thinning: int) -> None:
        self._thinning = thinning
        self._shape = shape
        self._views: dict[int, View] = {}
        self._paths: dict[int, Path] = {}
        self._poses: dict[int, Pose] = {}
        self.why_not = ""
        known = [(film, film.poses()) for film in films]
        self._standing = all(poses and _same(list(poses.values())) for _, poses in known)
        if self._standing:
            return
        for film, poses in known:
            if len(film.aovs) > len(self._paths) and poses:
                self._paths, self._poses = film.aovs, poses
        if not self._paths:
            self.why_not = (
                "No flicker pictures: the camera moves, and no run has AOVs. Run the render command of one of them "
                "again with --aovs, which adds that to a finished run, and compare again."
            )

    def step(self, before: int | None, number: int) -> tuple[Warp | None, bool]:
        """Where pixels were in the previous frame (None: in the same place), and whether that is known."""
        if before is None or number != before + 1:
            self._views.clear()
            return None, False
        if self._standing:
            return None, True
        if self.why_not or not {before, number} <= self._paths.keys():
            return None, False
        try:
            now, then = self._view(number), self._view(before)
        except InputError as error:
            self.why_not = f"No flicker pictures: {error}."
            return None, False
        self._views = {number: now}
        return warp(now, then), True

    def _view(self, number: int) -> View:
        if number not in self._views:
            view = View.read(self._paths[number], self._poses[number])
            if view.normal.shape != self._shape:
                raise InputError(f"{self._paths[number]}: has a different size from the frames")
            self._views[number] = view.thinned(self._thinning)
        return self._views[number]


def _same(poses: Sequence[Pose]) -> bool:
    """Whether the camera stands still."""
    first = poses[0]
    return all(
        np.allclose(pose.to_world, first.to_world, atol=1e-9) and pose.fov == first.fov for pose in poses
    )


def _plain(value: float) -> float | None:
    """A number that JSON can represent, rounded to the precision of a graph, or None."""
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _packed(sums: Sequence[NDArray[np.float64] | None], grid: Grid) -> bytes:
    """Luminance of the blocks of all frames, float32 little-endian; NaN where a frame is missing."""
    nothing = np.full((grid.rows, grid.columns), np.nan)
    return np.stack([nothing if each is None else each for each in sums]).astype("<f4").tobytes()


def _title(films: Sequence[Film]) -> str:
    for film in films:
        scene = film.record.get("scene")
        if isinstance(scene, dict) and (name := scene.get("title", scene.get("name"))):
            return str(name)
    return films[0].name

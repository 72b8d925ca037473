"""Compares two runs: error of each frame against a reference, and flicker over a region."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from steadylight.errors import InputError
from steadylight.images import exposure_of_files, read_exr, tone_map
from steadylight.metrics.region import Region
from steadylight.metrics.sequence import FrameSequence
from steadylight.metrics.still import Errors, errors_against, flip
from steadylight.metrics.temporal import bfm, bfm_excess, mean_luminance, normalised, overshoot

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FLIP_FRAMES = 24
"""Maximum number of frames, equally spaced, for which FLIP is computed; it takes seconds for a large frame."""

_ERRORS = ("rel_rmse", "rel_trimmed", "rel_median", "rel_bias")

_THUMBNAIL = 720  # pixels of the longer side


@dataclass(frozen=True, eq=False)
class SequenceMeasures:
    """Measures of one sequence.

    Attributes:
        path: the folder.
        brightness: (T,) mean luminance of the region, divided by its mean over the sequence.
        errors: errors of each compared frame, or None if the sequence was not compared.
        flip: (C,) mean FLIP, NaN where it was not measured, or None.
        bfm_excess: BFM excess over the reference sequence, or None unless that has every frame.
        temporal: whether the frames have no gaps. Over a gap, the view changes, so differences are not flicker.
    """

    path: Path
    brightness: NDArray[np.float64]
    errors: tuple[Errors, ...] | None = None
    flip: NDArray[np.float64] | None = None
    bfm_excess: float | None = None
    temporal: bool = True

    def series(self, name: str) -> NDArray[np.float64] | None:
        """One field of the `Errors` of each compared frame, (C,), or None."""
        return None if self.errors is None else np.array([getattr(each, name) for each in self.errors])

    @property
    def rel_rmse(self) -> NDArray[np.float64] | None:
        """Relative RMSE of each compared frame, (C,), or None."""
        return self.series("rel_rmse")

    @property
    def rel_bias(self) -> NDArray[np.float64] | None:
        """Relative bias of each compared frame, (C,), or None."""
        return self.series("rel_bias")

    @property
    def bfm(self) -> NDArray[np.float64]:
        """BFM(t) of each step, (T-1,); the first value belongs to the second frame. (0,) if not temporal."""
        return bfm(self.brightness) if self.temporal else np.zeros(0)

    @property
    def overshoot(self) -> float | None:
        """Flicker without the trend caused by the camera; None with fewer than 3 frames, or if not temporal."""
        return overshoot(self.brightness) if self.temporal and self.brightness.size >= 3 else None

    def means(self) -> dict[str, float | None]:
        """Every measure as one number (means over the compared frames); None if not measured."""
        return {
            "brightness_ratio": _mean(self.series("brightness")),
            **{name: _mean(self.series(name)) for name in _ERRORS},
            "flip": _mean(self.flip),
            "bfm": _mean(self.bfm),
            "overshoot": self.overshoot,
            "bfm_excess": self.bfm_excess,
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measures of two runs; `plot.plot_comparison` draws them.

    Attributes:
        a: the first run, usually the baseline.
        b: the second run.
        reference: the reference sequence's brightness, or None unless it has every frame.
        truth: folder of the ground truth for errors: the reference, or the first run without a reference.
        truth_b: folder of the second reference, if there is one.
        frames: T frame numbers that both runs have, used for brightness and BFM.
        compared: C frame numbers with an error: those of `frames` that `truth` has.
        region: region in which brightness was measured; errors are over the whole image.
        width: pixels.
        height: pixels.
        exposure: exposure of the thumbnail and of FLIP.
        thumbnail: (h, w, 3) uint8, the middle frame of the second run.
        thumbnail_frame: number of that frame.
    """

    a: SequenceMeasures
    b: SequenceMeasures
    reference: SequenceMeasures | None
    truth: Path
    truth_b: Path | None
    frames: tuple[int, ...]
    compared: tuple[int, ...]
    region: Region
    width: int
    height: int
    exposure: float
    thumbnail: NDArray[np.uint8] = field(repr=False)
    thumbnail_frame: int

    @property
    def noise(self) -> float:
        """Relative noise of the ground truth, a mean over the compared frames; see `still.Errors`."""
        return float(np.mean([each.noise for each in self.b.errors or ()]))

    @property
    def overshoot_ratio(self) -> float | None:
        """Overshoot of a divided by that of b; above 1, b flickers less."""
        return _ratio(self.a.overshoot, self.b.overshoot)

    @property
    def bfm_excess_ratio(self) -> float | None:
        """BFM excess of a divided by that of b."""
        return _ratio(self.a.bfm_excess, self.b.bfm_excess)

    def to_dict(self) -> dict[str, Any]:
        """All numbers as plain data (JSON); None if not measured."""
        sequences = {"a": self.a, "b": self.b, "reference": self.reference}
        return {
            "frames": list(self.frames),
            "compared": list(self.compared),
            "truth": str(self.truth),
            "truth_b": None if self.truth_b is None else str(self.truth_b),
            "truth_noise": _plain(self.noise),
            "region": list(self.region.pixels(self.width, self.height)),
            "overshoot_ratio": _plain(self.overshoot_ratio),
            "bfm_excess_ratio": _plain(self.bfm_excess_ratio),
            **{
                name: _sequence_dict(sequence) for name, sequence in sequences.items() if sequence is not None
            },
        }


def compare_runs(
    run_a: Path | str,
    run_b: Path | str,
    reference: Path | str | None = None,
    region: Region | Sequence[float] | None = None,
    reference_b: Path | str | None = None,
) -> Comparison:
    """Measure two runs over the frames that both have.

    With a reference, both are compared to it on the frames that it has (a few stills are enough for the errors; BFM
    excess needs all). Without one, the second run is compared to the first. Frames are read one at a time.

    Args:
        run_a: a run directory, or a folder of EXR files whose names end in the frame number.
        run_b: the same.
        reference: the same, usually a `--mode path` run with many samples.
        region: region in which brightness is measured: a `Region`, four edges, or None for the whole image.
        reference_b: a second reference with another seed. The mean of both is then the reference, and `rel_rmse` and
            `rel_bias` exclude their noise.

    Raises:
        InputError: a folder without frames, sequences that share no frame or have gaps, frames of different
            sizes or that do not decode, or a region outside the image.
    """
    a, b = FrameSequence.open(Path(run_a)), FrameSequence.open(Path(run_b))
    if reference is None and reference_b is not None:
        raise InputError(
            "--reference-b: needs --reference, which it differs from in its seed only; give both"
        )
    truth = a if reference is None else FrameSequence.open(Path(reference))
    second = None if reference_b is None else FrameSequence.open(Path(reference_b))
    if second is not None:
        common = {number: truth.frames[number] for number in truth.frames if number in second.frames}
        if not common:
            truth.shared_with(second)
        truth = FrameSequence(truth.path, common)
    frames = a.shared_with(b)
    compared = tuple(number for number in frames if number in truth.frames)
    if not compared:
        truth.shared_with(FrameSequence(b.path, {number: b.frames[number] for number in frames}))
    exposure = exposure_of_files([truth.frames[number] for number in compared], sample=8)
    where = Region.of(region)
    sequences = {"a": a, "b": b} | ({} if reference is None else {"reference": truth})
    tally = _Tally(sequences, where, exposure, compared, second)
    for number in frames:
        tally.add(number)
    return _conclude(tally, frames, truth)


class _Tally:
    """Collects the measures frame by frame.

    Args:
        sequences: `a`, `b` and, if there is one, `reference`.
        region: region in which brightness is measured.
        exposure: exposure of FLIP.
        compared: frame numbers with an error.
        second: the second reference.
    """

    def __init__(
        self,
        sequences: dict[str, FrameSequence],
        region: Region,
        exposure: float,
        compared: tuple[int, ...],
        second: FrameSequence | None = None,
    ) -> None:
        self.sequences, self.region, self.exposure, self.compared = sequences, region, exposure, compared
        self.second = second
        steps = np.linspace(0, len(compared) - 1, min(FLIP_FRAMES, len(compared))).round().astype(int)
        self.flipped = {compared[step] for step in steps}
        self.luminance: dict[str, list[float]] = {name: [] for name in sequences}
        self.errors: dict[str, list[Errors]] = {name: [] for name in sequences}
        self.flips: dict[str, list[float]] = {name: [] for name in sequences}
        self.shape: tuple[int, ...] | None = None

    def add(self, number: int) -> None:
        """Measure one frame of every sequence that has it."""
        images = {
            n: self._read(sequence, number)
            for n, sequence in self.sequences.items()
            if number in sequence.frames
        }
        truth = "reference" if "reference" in self.sequences else "a"
        references = [images[truth]] if truth in images else []
        if references and self.second is not None:
            references.append(self._read(self.second, number))
            images[truth] = np.mean(references, axis=0)
        for name, image in images.items():
            self.luminance[name].append(mean_luminance(image, self.region))
        if number not in self.compared:
            return
        for name in {"a", "b"} - {truth}:
            self.errors[name].append(errors_against(images[name], *references))
            seen = flip(images[name], images[truth], self.exposure) if number in self.flipped else np.nan
            self.flips[name].append(seen)

    def _read(self, sequence: FrameSequence, number: int) -> NDArray[np.float32]:
        path = sequence.frames[number]
        image = read_exr(path)
        if self.shape is None:
            self.shape, self.first = image.shape, path
        if image.shape != self.shape:
            found, right = (f"{shape[1]}x{shape[0]}" for shape in (image.shape, self.shape))
            raise InputError(f"{path}: is {found} pixels, but {self.first} is {right}; sizes must match")
        return image


def _conclude(tally: _Tally, frames: tuple[int, ...], truth: FrameSequence) -> Comparison:
    """The comparison from the collected measures."""
    assert tally.shape is not None
    height, width = tally.shape[:2]
    steps = np.diff(frames)
    temporal = bool(steps.size and (steps == 1).all())
    brightness = {name: normalised(values) for name, values in tally.luminance.items()}
    reference = None
    if "reference" in tally.sequences and len(tally.luminance["reference"]) == len(frames):
        reference = SequenceMeasures(truth.path, brightness["reference"], temporal=temporal)
    sequences = []
    for name in ("a", "b"):
        measured = tally.errors[name]
        sequences.append(
            SequenceMeasures(
                path=tally.sequences[name].path,
                brightness=brightness[name],
                errors=tuple(measured) if measured else None,
                flip=np.array(tally.flips[name]) if measured else None,
                bfm_excess=bfm_excess(brightness[name], reference.brightness)
                if reference and temporal
                else None,
                temporal=temporal,
            )
        )
    middle = frames[len(frames) // 2]
    picture = tone_map(read_exr(tally.sequences["b"].frames[middle]), tally.exposure)
    thumbnail = Image.fromarray(picture)
    thumbnail.thumbnail((_THUMBNAIL, _THUMBNAIL))
    return Comparison(
        a=sequences[0],
        b=sequences[1],
        reference=reference,
        truth=truth.path,
        truth_b=None if tally.second is None else tally.second.path,
        frames=frames,
        compared=tally.compared,
        region=tally.region,
        width=width,
        height=height,
        exposure=tally.exposure,
        thumbnail=np.asarray(thumbnail),
        thumbnail_frame=middle,
    )


def _sequence_dict(sequence: SequenceMeasures) -> dict[str, Any]:
    series = {"brightness_ratio": sequence.series("brightness")}
    series |= {name: sequence.series(name) for name in _ERRORS}
    series |= {name: getattr(sequence, name) for name in ("flip", "bfm", "brightness")}
    return {
        "path": str(sequence.path),
        "mean": {name: _plain(value) for name, value in sequence.means().items()},
        "frames": {
            name: None if values is None else [_plain(value) for value in values]
            for name, values in series.items()
        },
    }


def _plain(value: float | None) -> float | None:
    """A number that JSON can represent, or None."""
    return None if value is None or not np.isfinite(value) else float(value)


def _mean(values: NDArray[np.float64] | None) -> float | None:
    """Mean over the measured values; None without any."""
    if values is None or np.isnan(values).all():
        return None
    return float(np.nanmean(values))


def _ratio(baseline: float | None, value: float | None) -> float | None:
    if baseline is None or value is None:
        return None
    if value == 0.0:
        return 1.0 if baseline == 0.0 else float("inf")
    return baseline / value

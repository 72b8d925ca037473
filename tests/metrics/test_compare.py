from __future__ import annotations

import json
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

from steadylight.errors import InputError, StorageError
from steadylight.images import write_exr
from steadylight.metrics.compare import Comparison, compare_runs
from steadylight.metrics.plot import plot_comparison
from steadylight.metrics.still import errors_against, estimated_noise

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def write_film(folder: Path, levels: Sequence[float] | Mapping[int, float], width: int = 16) -> Path:
    """A sequence of grey frames in the layout of a run directory; the left half stays at 1."""
    (folder / "frames").mkdir(parents=True)
    numbered = levels if isinstance(levels, dict) else dict(enumerate(levels, start=1))
    for number, level in numbered.items():
        image = np.full((12, width, 3), level, np.float32)
        image[:, : width // 2] = 1
        write_exr(folder / "frames" / f"frame_{number:05d}.exr", image)
    return folder


RIGHT = (0.5, 0.0, 1.0, 1.0)


@pytest.fixture
def sequences(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A flickering sequence, a steadier one and a steady reference, all with mean 1."""
    return (
        write_film(tmp_path / "single-pass", [0.8, 1.2, 0.8, 1.2]),
        write_film(tmp_path / "two-pass", [0.95, 1.05, 0.95, 1.05]),
        write_film(tmp_path / "reference", [1.0, 1.0, 1.0, 1.0]),
    )


class TestAgainstAReference:
    @pytest.fixture
    def comparison(self, sequences: tuple[Path, Path, Path]) -> Comparison:
        return compare_runs(*sequences, RIGHT)

    def test_flicker_of_the_region_is_as_calculated(self, comparison: Comparison) -> None:
        assert comparison.a.bfm == pytest.approx([0.4] * 3, rel=1e-6)
        assert comparison.b.bfm == pytest.approx([0.1] * 3, rel=1e-6)
        assert comparison.a.overshoot == pytest.approx(0.4, rel=1e-6)
        assert comparison.b.bfm_excess == pytest.approx(0.1, rel=1e-6)
        assert comparison.overshoot_ratio == pytest.approx(4.0, rel=1e-5)
        assert comparison.bfm_excess_ratio == pytest.approx(4.0, rel=1e-5)

    def test_errors_of_each_frame_are_as_calculated(self, comparison: Comparison) -> None:
        # half of the image is off by 0.05; floor 0.1
        expected = np.sqrt(0.5) * 0.05 / 1.1
        assert comparison.b.rel_rmse == pytest.approx([expected] * 4, rel=1e-5)
        assert comparison.b.rel_bias == pytest.approx(np.array([-1, 1, -1, 1]) * 0.025 / 1.1, rel=1e-5)
        assert comparison.a.means()["flip"] > comparison.b.means()["flip"] > 0

    def test_all_numbers_are_plain_data(self, comparison: Comparison) -> None:
        found = json.loads(json.dumps(comparison.to_dict(), allow_nan=False))
        assert found["region"] == [8, 0, 16, 12]
        assert found["a"]["mean"]["overshoot"] == pytest.approx(0.4, rel=1e-6)
        assert len(found["reference"]["frames"]["bfm"]) == 3

    def test_the_plot_is_a_picture_and_leaves_no_global_state(
        self, comparison: Comparison, tmp_path: Path
    ) -> None:
        before = dict(mpl.rcParams)
        plot_comparison(comparison, tmp_path / "a.png")
        plot_comparison(comparison, tmp_path / "b.png")
        assert dict(mpl.rcParams) == before
        assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
        with Image.open(tmp_path / "a.png") as picture:
            assert picture.size == (1440, 840)

    def test_a_plot_that_cannot_be_written_is_named(self, comparison: Comparison, tmp_path: Path) -> None:
        with pytest.raises(StorageError, match=r"a\.png: cannot be written"):
            plot_comparison(comparison, tmp_path / "gone" / "a.png")


def test_without_a_reference_the_second_run_is_held_against_the_first(
    sequences: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    comparison = compare_runs(sequences[2], sequences[1])
    assert comparison.truth == sequences[2]
    assert comparison.a.rel_rmse is None
    assert comparison.b.rel_rmse == pytest.approx([np.sqrt(0.5) * 0.05 / 1.1] * 4, rel=1e-5)
    assert (comparison.reference, comparison.b.bfm_excess, comparison.bfm_excess_ratio) == (None, None, None)
    plot_comparison(comparison, tmp_path / "a.png")


def test_a_reference_of_a_few_stills_gives_errors_but_no_excess(
    sequences: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    stills = write_film(tmp_path / "stills", {2: 1.0})
    comparison = compare_runs(sequences[0], sequences[1], stills)
    assert comparison.compared == (2,)
    assert comparison.b.rel_rmse is not None
    assert comparison.b.rel_rmse.shape == (1,)
    assert comparison.reference is None
    assert comparison.overshoot_ratio == pytest.approx(4.0, rel=1e-2)


def test_plain_folders_of_frames_are_compared_too(sequences: tuple[Path, Path, Path]) -> None:
    comparison = compare_runs(sequences[0] / "frames", str(sequences[1] / "frames"))
    assert comparison.frames == (1, 2, 3, 4)


def test_equal_films_have_no_error_and_a_ratio_of_one(sequences: tuple[Path, Path, Path]) -> None:
    comparison = compare_runs(sequences[2], sequences[2])
    same = {"brightness_ratio": 1.0, "bfm_excess": None}
    assert comparison.b.means() == dict.fromkeys(comparison.b.means(), 0.0) | same
    assert comparison.overshoot_ratio == 1.0


@pytest.mark.parametrize("numbers", [(3,), (1, 2, 9), (1, 46, 91)])
def test_frames_that_are_no_neighbours_have_errors_but_no_flicker(
    tmp_path: Path, numbers: tuple[int, ...]
) -> None:
    sequence = write_film(tmp_path / "sequence", dict.fromkeys(numbers, 0.5))
    comparison = compare_runs(sequence, sequence, sequence)
    assert comparison.b.overshoot is None
    assert comparison.b.bfm.size == 0
    assert comparison.b.bfm_excess is None
    plot_comparison(comparison, tmp_path / "a.png")


def test_frames_of_another_size_are_named_with_both_sizes(
    sequences: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    small = write_film(tmp_path / "small", [1.0] * 4, width=8)
    with pytest.raises(InputError, match=r"small.*is 8x12 pixels, but .*single-pass.* is 16x12"):
        compare_runs(sequences[0], small)


def test_a_reference_of_other_frames_is_named(sequences: tuple[Path, Path, Path], tmp_path: Path) -> None:
    later = write_film(tmp_path / "later", {7: 1.0})
    with pytest.raises(InputError, match=r"later \(frames 7\) and .*two-pass \(frames 1-4\) have no frame"):
        compare_runs(sequences[0], sequences[1], later)


def test_a_region_beyond_the_image_is_refused(sequences: tuple[Path, Path, Path]) -> None:
    with pytest.raises(InputError, match="0,0,17,12: extends beyond the image of 16x12"):
        compare_runs(sequences[0], sequences[1], region=(0, 0, 17, 12))


def noisy(level: float, seed: int, noise: float = 0.3) -> np.ndarray:
    """A picture with a dark half, and noise as of few samples: never negative, the mean as it should be."""
    rng = np.random.default_rng(seed)
    image = np.full((96, 128, 3), level)
    image[:, :64] *= 0.02
    return (image * rng.gamma(1 / noise**2, noise**2, image.shape)).astype(np.float32)


class TestAgainstNoise:
    """A frame that is 7 % too dark, against references with 30 % noise and fireflies."""

    DARK = np.where(np.arange(128)[None, :, None] < 64, 0.02, 1.0).repeat(96, 0).repeat(3, 2) * 0.93

    def test_brightness_is_seen_through_the_noise(self) -> None:
        assert errors_against(self.DARK, noisy(1.0, 1)).brightness == pytest.approx(0.93, abs=0.01)

    def test_two_references_give_the_error_without_their_noise(self) -> None:
        one, two = (
            errors_against(self.DARK, noisy(1.0, 1)),
            errors_against(self.DARK, noisy(1.0, 1), noisy(1.0, 2)),
        )
        # The bright half is off by 0.07 / (1 + 0.05), the dark half by 0.0014 / (0.02 + 0.05).
        expected = np.sqrt(((0.07 / 1.05) ** 2 + (0.0014 / 0.07) ** 2) / 2)
        assert one.rel_rmse > 3 * expected
        assert two.rel_rmse == pytest.approx(expected, rel=0.15)
        assert two.rel_bias == pytest.approx(-(0.07 / 1.05 + 0.0014 / 0.07) / 2, rel=0.15)

    def test_the_noise_of_a_reference_is_estimated_from_it_alone(self) -> None:
        reference = noisy(1.0, 1, noise=0.1)
        assert estimated_noise(reference[:, 64:], 1.0) == pytest.approx(0.1, rel=0.1)

    def test_fireflies_move_no_robust_error(self) -> None:
        image = np.ones((96, 128, 3))
        image[::16, ::16] = 500.0
        errors = errors_against(image, np.ones_like(image))
        assert errors.rel_rmse > 10
        assert errors.rel_trimmed == errors.rel_median == 0.0


def test_a_second_reference_stands_beside_the_first(
    sequences: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    second = write_film(tmp_path / "second", {2: 1.2, 3: 1.2, 9: 1.0})
    comparison = compare_runs(*sequences, RIGHT, second)
    assert comparison.compared == (2, 3)
    assert comparison.truth_b == second
    assert comparison.noise == pytest.approx(np.sqrt(0.5) * 0.1 / 1.1 / 1.05, rel=0.3)
    assert comparison.to_dict()["truth_noise"] == comparison.noise
    with pytest.raises(InputError, match="--reference-b: needs --reference"):
        compare_runs(sequences[0], sequences[1], reference_b=second)

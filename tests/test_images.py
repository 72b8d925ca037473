from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from steadylight import images
from steadylight.errors import InputError, StorageError


@pytest.fixture
def picture() -> np.ndarray:
    """37 x 53 pixels, smooth and compressible, with values from 0 to 40."""
    y, x = np.mgrid[0:37, 0:53].astype(np.float32) / 53
    return np.stack([x, y * 40, x * y], axis=-1)


@pytest.fixture
def frame(tmp_path: Path, picture: np.ndarray) -> Path:
    path = tmp_path / "frame_00001.exr"
    images.write_exr(path, picture)
    return path


class TestExr:
    def test_what_is_written_is_read_back_bit_for_bit(self, frame: Path, picture: np.ndarray) -> None:
        read = images.read_exr(frame)
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read, picture)

    def test_the_same_image_gives_the_same_bytes(self, tmp_path: Path, picture: np.ndarray) -> None:
        first, second = tmp_path / "a.exr", tmp_path / "longer-name.exr"
        images.write_exr(first, picture, {"seed": 3, "frame": 1})
        images.write_exr(second, np.asfortranarray(picture), {"frame": 1, "seed": 3})
        assert first.read_bytes() == second.read_bytes()

    def test_metadata_comes_back_as_text(self, tmp_path: Path, picture: np.ndarray) -> None:
        images.write_exr(tmp_path / "a.exr", picture, {"seed": 2**32 - 1, "mode": "two-pass"})
        assert images.read_exr_metadata(tmp_path / "a.exr") == {"seed": "4294967295", "mode": "two-pass"}

    def test_metadata_cannot_replace_the_formats_own_attributes(
        self, tmp_path: Path, picture: np.ndarray
    ) -> None:
        with pytest.raises(ValueError, match="dataWindow"):
            images.write_exr(tmp_path / "a.exr", picture, {"dataWindow": "1"})

    def test_half_float_files_with_alpha_from_other_programs_are_read(self, tmp_path: Path) -> None:
        pixels = np.full((4, 5, 4), 0.25, np.float16)
        header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGBA": pixels}).write(str(tmp_path / "a.exr"))
        np.testing.assert_array_equal(images.read_exr(tmp_path / "a.exr"), np.full((4, 5, 3), 0.25))

    @pytest.mark.parametrize("shape", [(4, 5), (4, 5, 4), (0, 5, 3)])
    def test_only_rgb_images_are_written(self, tmp_path: Path, shape: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match="height, width, 3"):
            images.write_exr(tmp_path / "a.exr", np.zeros(shape))

    @pytest.mark.parametrize("target", ["missing/a.exr", "."])
    def test_a_place_that_cannot_be_written_is_named(
        self, tmp_path: Path, picture: np.ndarray, target: str
    ) -> None:
        with pytest.raises(StorageError, match="cannot be written"):
            images.write_exr(tmp_path / target, picture)

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the Linux device that is always full")
    def test_a_full_disk_is_named(self, picture: np.ndarray) -> None:
        with pytest.raises(StorageError, match=r"/dev/full.*No space left"):
            images.write_exr(Path("/dev/full"), picture)


class TestValidation:
    def test_a_good_frame_passes(self, frame: Path) -> None:
        images.validate_exr(frame, width=53, height=37)

    def test_a_frame_cut_anywhere_is_refused_without_a_word_on_the_terminal(
        self, frame: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        whole = frame.read_bytes()
        for length in range(0, len(whole), 11):
            frame.write_bytes(whole[:length])
            with pytest.raises(InputError, match=r"frame_00001\.exr: is (truncated|not a readable EXR)"):
                images.validate_exr(frame)
        assert capfd.readouterr() == ("", "")

    def test_a_frame_with_a_flipped_bit_is_refused_without_a_word_on_the_terminal(
        self, frame: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]
    ) -> None:
        whole, refused = frame.read_bytes(), 0
        for place in range(8, len(whole), 13):
            content = bytearray(whole)
            content[place] ^= 1 << place % 8
            frame.write_bytes(content)
            with suppress(InputError):
                # A bit of the header that says nothing about the pixels may change.
                assert np.array_equal(images.read_exr(frame), picture)
                continue
            refused += 1
        assert refused > 0.8 * len(whole) / 13
        assert capfd.readouterr() == ("", "")

    def test_a_frame_with_changed_pixels_is_refused(self, tmp_path: Path) -> None:
        noise = np.random.default_rng(1).random((16, 16, 3), dtype=np.float32)  # stored as it is
        path = tmp_path / "frame.exr"
        images.write_exr(path, noise)
        content = bytearray(path.read_bytes())
        content[-40] ^= 1
        path.write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            images.validate_exr(path)

    def test_pixels_that_do_not_decompress_are_refused(self, frame: Path) -> None:
        content = bytearray(frame.read_bytes())
        content[-60:-40] = b"\xff" * 20
        frame.write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            images.validate_exr(frame)

    def test_a_file_of_another_format_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "frame.exr"
        path.write_text("not an image")
        with pytest.raises(InputError, match="no EXR magic number"):
            images.validate_exr(path)

    def test_a_missing_file_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"gone\.exr: no such file"):
            images.validate_exr(tmp_path / "gone.exr")

    def test_another_size_is_refused_with_both_sizes(self, frame: Path) -> None:
        with pytest.raises(InputError, match=r"is 53x37 pixels; expected 64x48"):
            images.validate_exr(frame, width=64, height=48)

    def test_missing_channels_are_named(self, tmp_path: Path) -> None:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"R": np.ones((2, 2), np.float32)}).write(str(tmp_path / "a.exr"))
        with pytest.raises(InputError, match="no channel G, B"):
            images.validate_exr(tmp_path / "a.exr")

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_the_first_pixel_that_is_not_finite_is_named(
        self, tmp_path: Path, picture: np.ndarray, value: float
    ) -> None:
        picture[5, 7, 1] = value
        images.write_exr(tmp_path / "a.exr", picture)
        with pytest.raises(InputError, match=r"1 of 1961 pixels are not finite, the first at x=7 y=5"):
            images.validate_exr(tmp_path / "a.exr")


class TestToneMapping:
    def test_known_values_of_srgb(self) -> None:
        linear = np.array([[[0.0, 0.18, 0.5]]], np.float32)
        np.testing.assert_array_equal(images.tone_map(linear, 1.0), [[[0, 118, 188]]])

    def test_blenders_curves_have_their_known_middle_grey(self) -> None:
        # AgX leaves 0.18 where sRGB shows it; Filmic's medium contrast shows it at one half. Both end in white.
        grey = np.full((1, 1, 3), 0.18, np.float32)
        assert images.to_display(grey, 1.0, "agx")[0, 0, 0] == pytest.approx(0.4613, abs=2e-4)
        assert images.to_display(grey, 1.0, "filmic")[0, 0, 0] == pytest.approx(0.5, abs=1e-3)

    @pytest.mark.parametrize("tone", ["agx", "filmic", "srgb", "none"])
    def test_each_curve_rises_from_black_to_white(self, tone: str) -> None:
        ramp = np.geomspace(1e-3, 100, 200, dtype=np.float32)[:, None].repeat(3, axis=-1)
        shown = images.to_display(ramp, 1.0, tone)
        assert np.all(np.diff(shown[:, 0]) >= 0)
        assert shown.max() == pytest.approx(1.0, abs=2e-3)
        odd = np.array([[[-1.0, np.nan, -np.inf], [np.inf, np.inf, np.inf]]])
        assert images.tone_map(odd, 1.0, tone).tolist() == [[[0, 0, 0], [255, 255, 255]]]

    def test_without_a_curve_highlights_are_clipped(self) -> None:
        linear = np.array([[[0.18, 0.999, 3.0]]], np.float32)
        np.testing.assert_array_equal(images.tone_map(linear, 1.0, "none"), [[[118, 255, 255]]])

    def test_agx_bends_a_strong_colour_towards_white_where_srgb_keeps_it(self) -> None:
        red = np.array([[[8.0, 0.01, 0.01]]], np.float32)
        assert images.tone_map(red, 1.0, "agx")[0, 0, 1] > images.tone_map(red, 1.0, "srgb")[0, 0, 1] + 50

    def test_exposure_multiplies(self) -> None:
        linear = np.array([[[0.02, 0.1, 0.4]]], np.float32)
        np.testing.assert_array_equal(images.tone_map(linear, 2.0), images.tone_map(2 * linear, 1.0))

    def test_the_curve_rises_everywhere_and_never_reaches_beyond_white(self) -> None:
        ramp = np.linspace(0, 3, 4000, dtype=np.float32)
        display = images.to_display(ramp, 1.0)
        assert np.all(np.diff(display) > 0)
        assert display.max() < 1
        assert images.to_display(np.array([1e30, np.inf]), 1.0) == pytest.approx(1.0, abs=1e-6)

    def test_the_shoulder_begins_without_a_kink(self) -> None:
        step = 1e-3
        around = images.to_display(np.array([-1, 0, 1]) * step + images.SHOULDER, 1.0).astype(np.float64)
        below, above = np.diff(around)
        assert above == pytest.approx(below, rel=0.01)

    def test_negative_and_undefined_values_are_black(self) -> None:
        assert images.tone_map(np.array([[[-1.0, np.nan, 0.0]]]), 1.0).tolist() == [[[0, 0, 0]]]


class TestExposure:
    def test_a_grey_film_is_brought_to_middle_grey(self) -> None:
        assert images.animation_exposure([np.full((2, 3, 3), 0.09)]) == pytest.approx(2.0)

    def test_the_log_average_decides_within_a_frame(self) -> None:
        frame = np.stack([np.full((2, 3), 0.01), np.full((2, 3), 1.0)])[..., None].repeat(3, axis=-1)
        assert images.animation_exposure([frame]) == pytest.approx(0.18 / 0.1)

    def test_a_frame_that_is_bright_all_over_stays_bright(self) -> None:
        # Nine tenths at 1, one tenth at 1/100: the key is 10^-0.2, and its distance to the ends gives f = 0.8.
        frame = np.repeat(np.array([0.01] + 9 * [1.0]), 30).reshape(10, 30, 1).repeat(3, axis=-1)
        expected = 0.18 * 4**0.8 / 10**-0.2
        assert images.animation_exposure([frame]) == pytest.approx(expected)
        assert images.animation_exposure([1.0 - 0.99 * (frame > 0.5)]) == pytest.approx(0.18 / 10**-1.8)

    def test_black_frames_and_black_pixels_do_not_count(self) -> None:
        half = np.zeros((2, 2, 3))
        half[0] = 0.18
        assert images.animation_exposure([np.zeros((2, 2, 3)), half]) == pytest.approx(1.0)

    def test_a_black_film_is_left_as_it_is(self) -> None:
        assert images.animation_exposure([np.zeros((2, 2, 3))]) == 1.0
        assert images.animation_exposure([]) == 1.0

    def test_a_sample_of_files_decides_for_the_film(self, tmp_path: Path) -> None:
        paths = [tmp_path / f"frame_{number:05d}.exr" for number in range(5)]
        for path in paths:
            images.write_exr(path, np.full((2, 2, 3), 0.36))
        assert images.exposure_of_files(paths, sample=3) == pytest.approx(0.5)
        assert images.exposure_of_files([]) == 1.0


class TestPng:
    def test_a_picture_is_written_as_it_is(self, tmp_path: Path) -> None:
        picture = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
        images.write_png(tmp_path / "a.png", picture)
        with Image.open(tmp_path / "a.png") as read:
            np.testing.assert_array_equal(np.asarray(read), picture)

    def test_a_picture_cut_short_is_found(self, tmp_path: Path) -> None:
        path = tmp_path / "a.png"
        images.write_png(path, np.arange(3000, dtype=np.uint8).reshape(40, 25, 3))
        images.validate_png(path)
        path.write_bytes(path.read_bytes()[:-200])
        with pytest.raises(InputError, match=r"a\.png: is not a readable PNG image"):
            images.validate_png(path)

    def test_a_place_that_cannot_be_written_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(StorageError, match=r"a\.png: cannot be written: No such file"):
            images.write_png(tmp_path / "missing" / "a.png", np.zeros((2, 2, 3), np.uint8))

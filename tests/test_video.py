from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from steadylight import images
from steadylight.errors import InputError, StorageError
from steadylight.settings import MOST_PIXELS
from steadylight.video import Look, compile_video, validate_video


def film(folder: Path, count: int, height: int = 48, width: int = 64) -> list[Path]:
    """Frames in which a bright bar travels over a gradient."""
    paths = []
    for number in range(1, count + 1):
        image = np.full((height, width, 3), 0.2, np.float32)
        image[..., 0] = np.linspace(0, 0.5, width)
        image[:, number : number + 4] = 0.9
        paths.append(folder / f"frame_{number:05d}.exr")
        images.write_exr(paths[-1], image)
    return paths


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="yuv420p") for frame in container.decode(video=0)]


def test_a_film_has_all_frames_at_the_right_rate_with_its_colour_tagged(tmp_path: Path) -> None:
    compile_video(film(tmp_path, 13), tmp_path / "a.mp4", fps=24, look=Look(1.0))
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frame = next(container.decode(stream))
        assert (stream.frames, stream.average_rate, stream.codec_context.name) == (13, 24, "h264")
        assert (frame.width, frame.height, frame.format.name) == (64, 48, "yuv420p")
        assert (frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range) == (1, 1, 1, 1)


@pytest.mark.parametrize("fps", [1e-3, 1e3])
def test_every_frame_rate_that_the_settings_allow_makes_a_film(tmp_path: Path, fps: float) -> None:
    compile_video(film(tmp_path, 3), tmp_path / "a.mp4", fps=fps, look=Look(1.0))
    assert len(decode(tmp_path / "a.mp4")) == 3


def test_the_largest_image_that_the_settings_allow_makes_a_film(tmp_path: Path) -> None:
    write = film(tmp_path, 1, height=2, width=MOST_PIXELS)
    compile_video(write, tmp_path / "a.mp4", fps=25, look=Look(1.0))
    assert decode(tmp_path / "a.mp4")[0].shape[1] == MOST_PIXELS


@pytest.mark.parametrize("folder", ["10:30", "http:", "pipe:1", "file:a", "%d"])
def test_a_folder_whose_name_begins_like_a_url_is_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(folder).mkdir()
    compile_video(film(tmp_path, 2), Path(folder) / "a.mp4", fps=25, look=Look(1.0))
    assert (tmp_path / folder / "a.mp4").is_file()


def test_the_index_stands_before_the_pictures(tmp_path: Path) -> None:
    compile_video(film(tmp_path, 3), tmp_path / "a.mp4", fps=25, look=Look(1.0))
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize(
    ("colour", "luma", "cb", "cr"),
    # Rec. 709, limited range, of display values at 200/255: 16 + 219 Y', 128 + 224 C
    [
        ((1, 0, 0), 53, 108, 216),
        ((0, 1, 0), 139, 60, 48),
        ((0, 0, 1), 28, 216, 120),
        ((1, 1, 1), 188, 128, 128),
    ],
)
def test_colours_are_encoded_as_rec_709(
    tmp_path: Path, colour: tuple[int, int, int], luma: int, cb: int, cr: int
) -> None:
    linear = ((200 / 255 + 0.055) / 1.055) ** 2.4
    images.write_exr(tmp_path / "a.exr", np.full((32, 32, 3), linear) * colour)
    compile_video([tmp_path / "a.exr"], tmp_path / "a.mp4", fps=25, look=Look(1.0))
    planes = decode(tmp_path / "a.mp4")[0].reshape(-1)
    measured = [int(np.median(part)) for part in np.split(planes, [1024, 1280])]
    assert measured == pytest.approx([luma, cb, cr], abs=2)


def test_frames_come_in_order_and_look_like_the_pictures(tmp_path: Path) -> None:
    paths = film(tmp_path, 5)
    compile_video(paths, tmp_path / "a.mp4", fps=25, look=Look(0.8))
    for path, planes in zip(paths, decode(tmp_path / "a.mp4"), strict=True):
        expected = images.luminance(images.tone_map(images.read_exr(path), 0.8))
        luma = planes[:48].astype(float)  # limited range: 16 to 235
        assert np.abs((luma - 16) * 255 / 219 - expected).mean() < 2


@pytest.mark.parametrize(("height", "width"), [(47, 63), (1, 1), (48, 63)])
def test_odd_sizes_grow_to_even_ones(tmp_path: Path, height: int, width: int) -> None:
    compile_video(film(tmp_path, 2, height, width), tmp_path / "a.mp4", fps=25, look=Look(1.0))
    validate_video(tmp_path / "a.mp4", 2, width + width % 2, height + height % 2)


def test_the_same_frames_give_the_same_film(tmp_path: Path) -> None:
    paths = film(tmp_path, 4)
    for name in ("a.mp4", "b.mp4"):
        compile_video(paths, tmp_path / name, fps=29.97, look=Look(1.0))
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_the_encoder_has_one_thread_because_several_may_give_other_bytes(tmp_path: Path) -> None:
    compile_video(film(tmp_path, 2), tmp_path / "a.mp4", fps=24, look=Look(1.0))
    # The encoder writes its settings into the film.
    assert b" threads=1 " in (tmp_path / "a.mp4").read_bytes()


def test_a_film_longer_than_any_queue_of_the_encoder_is_complete(tmp_path: Path) -> None:
    paths = film(tmp_path, 3, 16, 16) * 481
    compile_video(paths, tmp_path / "a.mp4", fps=25, look=Look(1.0))
    validate_video(tmp_path / "a.mp4", 1443, 16, 16)


class TestErrors:
    def test_no_frames(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"a\.mp4: there are no frames"):
            compile_video([], tmp_path / "a.mp4", fps=25, look=Look(1.0))

    def test_a_frame_of_another_size_is_named_and_nothing_is_left(self, tmp_path: Path) -> None:
        paths = film(tmp_path, 2)
        images.write_exr(paths[1], np.ones((10, 20, 3)))
        with pytest.raises(InputError, match=r"frame_00002\.exr: is 20x10 pixels, but .* is 64x48"):
            compile_video(paths, tmp_path / "a.mp4", fps=25, look=Look(1.0))
        assert sorted(path.name for path in tmp_path.iterdir()) == [path.name for path in paths]

    def test_a_missing_frame_is_named_and_the_old_film_stays(self, tmp_path: Path) -> None:
        (tmp_path / "a.mp4").write_text("old")
        with pytest.raises(InputError, match=r"gone\.exr: no such file"):
            compile_video([*film(tmp_path, 1), tmp_path / "gone.exr"], tmp_path / "a.mp4", 25, Look(1.0))
        assert (tmp_path / "a.mp4").read_text() == "old"

    def test_a_folder_that_is_gone_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(StorageError, match=r"a\.mp4: cannot be written"):
            compile_video(film(tmp_path, 1), tmp_path / "gone" / "a.mp4", fps=25, look=Look(1.0))

    def test_a_film_of_another_length_or_size_is_refused(self, tmp_path: Path) -> None:
        compile_video(film(tmp_path, 2), tmp_path / "a.mp4", fps=25, look=Look(1.0))
        with pytest.raises(InputError, match="has 2 frames; expected 3"):
            validate_video(tmp_path / "a.mp4", 3, 64, 48)
        with pytest.raises(InputError, match="is 64x48 pixels; expected 64x50"):
            validate_video(tmp_path / "a.mp4", 2, 64, 50)

    def test_a_file_that_is_no_film_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "a.mp4").write_text("not a film")
        with pytest.raises(InputError, match=r"a\.mp4: is not a readable video"):
            validate_video(tmp_path / "a.mp4", 1, 2, 2)

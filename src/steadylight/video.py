"""Video: encodes the frames as one widely playable H.264 file, as a stream, and reads it back.

The video is 8-bit 4:2:0 with Rec. 709 colour and limited range. `images.tone_map` applies one exposure to all frames,
so that the video does not flicker unless the frames do.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from steadylight.atomic_file import atomic_write
from steadylight.errors import InputError, RunError
from steadylight.images import read_exr, tone_map

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

_REC_709 = 1  # ISO/IEC 23091-2: primaries, transfer and matrix all have this number
# With four threads, a few of many encodes of the same frames gave different bytes. One thread costs little, because
# frames are read and tone-mapped one by one anyway.
_THREADS = 1


@dataclass(frozen=True)
class Look:
    """How scene-linear frames become pictures.

    Attributes:
        exposure: factor on scene-linear values for the whole video, from `images.animation_exposure`.
        tone: curve; see `images.to_display`.
        crf: x264's constant rate factor. 17 is visually almost lossless; each increase by 6 roughly halves the size of
            the file.
    """

    exposure: float
    tone: str = "srgb"
    crf: int = 17


def compile_video(frame_paths: Sequence[Path], output: Path, fps: float, look: Look) -> None:
    """Encode frames as an MP4 video: H.264 High, yuv420p, with the index at the front for streaming.

    Only one frame is in memory at a time. An odd width or height is padded by one pixel, a copy of the last column or
    row, because 4:2:0 needs even sizes. The file gets its final name only after it was read back completely.

    Args:
        frame_paths: EXR files in the order of the video, all of one size.
        output: the MP4 file; an existing one is replaced.
        fps: frames per second.
        look: exposure, tone curve and quality.

    Raises:
        InputError: there are no frames, or one is missing, does not decode or differs in size.
        RunError: the encoder failed.
        StorageError: the file cannot be written or read back.
    """
    if not frame_paths:
        raise InputError(f"{output}: there are no frames to encode")
    height, width = _even(read_exr(frame_paths[0])).shape[:2]
    with atomic_write(
        output, validate=lambda path: validate_video(path, len(frame_paths), width, height)
    ) as temporary:
        try:
            _encode(frame_paths, temporary, fps, look)
        except av.error.FFmpegError as error:
            if errno.errorcode.get(error.errno or 0) in _DISK_ERRORS:
                raise  # atomic_write explains what is wrong with the disk
            raise RunError(f"{output}: the video encoder failed: {error.strerror or error}") from error


def validate_video(path: Path, frames: int, width: int, height: int) -> None:
    """Decode a whole video and check its number and size of frames.

    Args:
        path: a video file.
        frames: expected number of frames.
        width: expected width, pixels.
        height: expected height, pixels.

    Raises:
        InputError: it does not decode, or the number or size of its frames is wrong.
    """
    count = 0
    try:
        with av.open(_address(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                if (frame.width, frame.height) != (width, height):
                    size = f"{frame.width}x{frame.height}"
                    raise InputError(f"{path}: is {size} pixels; expected {width}x{height}")
                count += 1
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"{path}: is not a readable video: {error}") from None
    if count != frames:
        raise InputError(f"{path}: has {count} frames; expected {frames}")


_DISK_ERRORS = frozenset(
    ["EACCES", "EDQUOT", "EIO", "ENOENT", "ENOSPC", "ENOTDIR", "EPERM", "EROFS", "ESTALE"]
)


def _address(path: Path) -> str:
    """A path in a form that FFmpeg does not take for a URL, as it would `10:30/film.mp4`."""
    return str(path) if path.is_absolute() else f"./{path}"


def _encode(frame_paths: Sequence[Path], path: Path, fps: float, look: Look) -> None:
    """Write the video to `path`."""
    size: tuple[int, ...] | None = None
    with av.open(_address(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        for frame_path in frame_paths:
            image = read_exr(frame_path)
            if size is None:
                size = image.shape
                _set_up(stream, _even(image).shape, look.crf)
            elif image.shape != size:
                found, right = (f"{shape[1]}x{shape[0]}" for shape in (image.shape, size))
                raise InputError(f"{frame_path}: is {found} pixels, but {frame_paths[0]} is {right}")
            picture = tone_map(_even(image), look.exposure, look.tone)
            container.mux(stream.encode(_video_frame(picture)))
        container.mux(stream.encode(None))


def _set_up(stream: Any, shape: tuple[int, ...], crf: int) -> None:
    """Set size, pixel format, quality and colour tags of the stream."""
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = "yuv420p"
    stream.options = {"crf": str(crf), "preset": "medium", "profile": "high", "threads": str(_THREADS)}
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = _REC_709
    context.color_range = ColorRange.MPEG


def _video_frame(picture: NDArray[np.uint8]) -> Any:
    """A picture in Rec. 709 luma and chroma, limited range."""
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    return frame.reformat(
        format="yuv420p",
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.MPEG,
        dst_colorspace=Colorspace.ITU709,
    )


def _even(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image, padded to an even number of rows and columns."""
    rows, columns = image.shape[:2]
    return np.pad(image, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")

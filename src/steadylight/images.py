"""Images: scene-linear float RGB in OpenEXR files, and 8-bit images made from them with one exposure.

An image is an array (height, width, 3) of float32, scene-linear RGB with Rec. 709 primaries and a D65 white,
row 0 at the top. Nothing here uses Mitsuba, whose bitmaps need a process-wide variant. EXR files are read and
written with the OpenEXR project's own Python package, PNG files with Pillow.
"""

from __future__ import annotations

import hashlib
import struct
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import OpenEXR
from PIL import Image

from steadylight.errors import InputError, StorageError
from steadylight.tone import VIEWS, apply_curve

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Rec. 709 luminance of linear R, G and B."""

MIDDLE_GREY = 0.18
"""Value to which `animation_exposure` maps the log-average luminance of a frame that is not bright all over."""

SHOULDER = 0.6
"""Exposed values up to this one are shown unchanged; brighter ones are compressed (see `to_display`)."""

_FINGERPRINT = "steadylight:pixels"
_COMPRESSED_ROWS = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""Rows per chunk of a scan-line file, by compression number (OpenEXR file layout)."""


# ------------------------------------------------------------------------------------------------ EXR files


def write_exr(path: Path, image: ArrayLike, metadata: Mapping[str, object] | None = None) -> None:
    """Write a scene-linear image as a float32 RGB scan-line EXR file with lossless ZIP compression.

    The same image and metadata give the same bytes: the header contains no date, host or file name. A hash of
    the pixels is stored in the header, so that `validate_exr` detects any damage.

    Args:
        path: where to write; an existing file is replaced. Give a temporary path if the file must not be
            visible before it is complete.
        image: (height, width, 3), stored as float32.
        metadata: extra header attributes, stored as text in the order of their names.

    Raises:
        ValueError: the image is not (height, width, 3), or a metadata name is reserved by EXR.
        StorageError: the file cannot be written.
    """
    pixels = np.ascontiguousarray(image, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ValueError(f"an image must have the shape (height, width, 3), not {pixels.shape}")
    header: dict[str, object] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        _FINGERPRINT: _fingerprint(pixels),
    }
    for name, value in sorted((metadata or {}).items()):
        if name in _RESERVED or name in header:
            raise ValueError(f"metadata name {name!r} is reserved by the EXR format")
        header[name] = str(value)
    try:
        OpenEXR.File(header, {"RGB": pixels}).write(str(path))
    except (RuntimeError, OSError) as error:
        raise StorageError(f"{path}: cannot be written: {_last_sentence(error)}") from None


def read_exr(path: Path) -> NDArray[np.float32]:
    """Read the R, G and B channels of any EXR file; other channels are ignored.

    Args:
        path: a single-part or multi-part file; of several parts, the first is read.

    Returns:
        (height, width, 3) float32, the data window; half floats are widened.

    Raises:
        InputError: the file does not exist, is truncated, does not decode, has no R, G and B, or was written by
            `write_exr` and its pixels do not match the stored hash.
    """
    opened = _open(path)
    channels = opened.channels()
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise InputError(
            f"{path}: has no channel {', '.join(missing)} (channels: {', '.join(channels) or 'none'}); "
            "an image needs R, G and B"
        )
    planes = [channels[name].pixels for name in "RGB"]
    if len({plane.shape for plane in planes}) > 1:
        raise InputError(f"{path}: channels R, G and B must have the same size")
    image = np.stack(planes, axis=-1).astype(np.float32, copy=False)
    stored = opened.header().get(_FINGERPRINT)
    if stored is not None and stored != _fingerprint(image):
        raise InputError(
            f"{path}: is damaged: its pixels do not match the stored hash; run the render command again, which "
            "makes it again, or restore it from a copy"
        )
    return image


def write_layers(path: Path, layers: Mapping[str, NDArray[np.floating]]) -> None:
    """Write named layers that are no colours, such as depth and normals, as float32 channels of one EXR file.

    Args:
        path: where to write; an existing file is replaced.
        layers: by channel, such as `Z`; each (height, width).

    Raises:
        StorageError: the file cannot be written.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(layer, dtype=np.float32) for name, layer in layers.items()}
    try:
        OpenEXR.File(header, channels).write(str(path))
    except (RuntimeError, OSError) as error:
        raise StorageError(f"{path}: cannot be written: {_last_sentence(error)}") from None


def read_layers(path: Path, *names: str) -> NDArray[np.float32]:
    """Read channels of an EXR file by name, (height, width, number of names) float32.

    Raises:
        InputError: the file does not exist, is truncated, does not decode, or lacks a channel.
    """
    channels = _open(path).channels()
    missing = [name for name in names if name not in channels]
    if missing:
        raise InputError(f"{path}: has no channel {', '.join(missing)} (channels: {', '.join(channels)})")
    return np.stack([channels[name].pixels for name in names], axis=-1).astype(np.float32, copy=False)


def read_exr_metadata(path: Path) -> dict[str, str]:
    """The text attributes in the header of an EXR file: what `write_exr` was given as metadata.

    Raises:
        InputError: the file does not exist, or does not decode.
    """
    header = _open(path, header_only=True).header()
    own = {*_RESERVED, _FINGERPRINT}
    return {name: value for name, value in header.items() if isinstance(value, str) and name not in own}


def validate_exr(path: Path, width: int | None = None, height: int | None = None) -> None:
    """Read a frame back and check that it is complete and valid.

    Args:
        path: an EXR file; if `write_exr` wrote it, its pixels are also checked against the stored hash.
        width: expected width, pixels; any if None.
        height: expected height, pixels; any if None.

    Raises:
        InputError: the file is missing, truncated, damaged, without R, G or B, of another size, or contains a
            NaN or an infinity (the message names the first such pixel).
    """
    image = read_exr(path)
    rows, columns = image.shape[:2]
    if (width or columns, height or rows) != (columns, rows):
        raise InputError(f"{path}: is {columns}x{rows} pixels; expected {width or 'any'}x{height or 'any'}")
    finite = np.isfinite(image).all(axis=-1)
    if not finite.all():
        y, x = np.argwhere(~finite)[0]
        raise InputError(
            f"{path}: {np.count_nonzero(~finite)} of {finite.size} pixels are not finite, "
            f"the first at x={x} y={y}: {image[y, x].tolist()}"
        )


_RESERVED = frozenset(
    {
        *("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio"),
        *("screenWindowCenter", "screenWindowWidth", "tiles", "type", "name", "version", "chunkCount"),
    }
)


def _fingerprint(pixels: NDArray[np.float32]) -> str:
    """SHA-256 of the size and values of an image, little-endian."""
    digest = hashlib.sha256(struct.pack("<2I", *pixels.shape[:2]))
    digest.update(np.ascontiguousarray(pixels, dtype="<f4").data)
    return digest.hexdigest()


def _open(path: Path, *, header_only: bool = False) -> OpenEXR.File:
    """Open an EXR file with at least one decodable part.

    Raises:
        InputError: says what is wrong with the file.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an EXR image")
    try:
        # OpenEXR does not raise on a truncated file but prints to stdout, so this is checked first.
        with path.open("rb") as file:
            complete = _end_of_last_chunk(file)
        size = path.stat().st_size
        if complete > size:
            raise InputError(f"{path}: is truncated: {size} of {complete} bytes")
        opened = OpenEXR.File(str(path), separate_channels=True, header_only=header_only)
    except (RuntimeError, ValueError, OSError, struct.error) as error:
        raise InputError(f"{path}: is not a readable EXR image: {_last_sentence(error)}") from None
    if not opened.parts:  # pixel data that does not decompress
        raise InputError(f"{path}: is damaged: its pixels do not decode")
    return opened


def _end_of_last_chunk(file: BinaryIO) -> int:
    """Expected size of a complete scan-line EXR file, from its header and the last entry of its offset table.

    Layout: magic, version, attributes (name, type, size, value) up to an empty name, a table of the offsets
    of all chunks, then the chunks (first row, size, data). Tiled, deep and multi-part files are left to
    OpenEXR; for them the result is 0.

    Raises:
        ValueError: not an EXR file, or the header is truncated.
    """
    magic, version = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    if magic != 20000630:
        raise ValueError("it has no EXR magic number")
    if version & 0x1A00:
        return 0
    attributes = {}
    while name := _read_name(file):
        _read_name(file)  # the type
        (size,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
        attributes[name] = file.read(size)
        if len(attributes[name]) < size:
            raise ValueError("it is truncated within the header")
    _, top, _, bottom = struct.unpack("<4i", attributes.get(b"dataWindow", b"").ljust(16, b"\0"))
    rows = _COMPRESSED_ROWS.get(attributes.get(b"compression", b"\xff")[0], 0)
    if rows == 0:
        return 0
    chunks = -(-(bottom - top + 1) // rows)
    table = file.read(8 * chunks)
    if len(table) < 8 * chunks:
        raise ValueError("it is truncated within the offset table")
    last = max(struct.unpack(f"<{chunks}Q", table), default=0)
    file.seek(min(last + 4, 2**62))
    (size,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
    return int(last + 8 + size)


def _read_name(file: BinaryIO) -> bytes:
    """A null-terminated name in the header."""
    name = b""
    while (letter := file.read(1)) != b"\0":
        if not letter or len(name) > 255:
            raise ValueError("it is truncated within the header")
        name += letter
    return name


def _last_sentence(error: Exception) -> str:
    """The error message of the library or the system, in one line."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


# ----------------------------------------------------------------------------------------- display images


def luminance(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rec. 709 luminance, scene-linear.

    Args:
        image: (..., 3) scene-linear RGB.

    Returns:
        (...) in the unit of the image.
    """
    weighted: NDArray[np.float64] = np.asarray(image, dtype=np.float64) @ np.array(LUMINANCE_WEIGHTS)
    return weighted


def animation_exposure(images: Iterable[NDArray[np.floating]]) -> float:
    """One exposure for a whole animation: the factor that shows its middle luminance as grey as it looks.

    The key of a frame is its log-average luminance (Reinhard, Stark, Shirley and Ferwerda 2002, "Photographic
    tone reproduction for digital images", eq. 1, doi:10.1145/566654.566575), here over the pixels that are
    lit at all (more than 1/10000 of the frame's mean) instead of with their small additive delta. It becomes middle
    grey, or brighter in a frame that is bright nearly everywhere, such as a desert under the sun, which would
    otherwise look like dusk (Reinhard 2002, "Parameter estimation for photographic tone reproduction", Journal of
    Graphics Tools 7(1), eq. 4: 0.18 * 4^f, where f is how much nearer the key is to the brightest hundredth than
    to the darkest, on a logarithmic scale). Never darker: rooms with a bright window stay visible. The animation's
    exposure is the median over frames, so that black frames, fades and a brief look into a lamp have no influence.

    Args:
        images: frames, or a sample of them, (height, width, 3) scene-linear RGB.

    Returns:
        Factor > 0 by which to multiply scene-linear values; 1 if nothing is lit.
    """
    exposures = []
    for image in images:
        values = luminance(image)
        values = values[np.isfinite(values)]
        lit = values[values > 1e-4 * max(values.mean(), 0.0)] if values.size else values
        if lit.size and values.mean() > 1e-12:
            logs = np.log(lit)
            low, key, high = np.percentile(logs, 1), logs.mean(), np.percentile(logs, 99)
            nearer = (2 * key - low - high) / (high - low) if high - low > 1e-6 else 0.0
            exposures.append(np.log(MIDDLE_GREY) + max(nearer, 0.0) * np.log(4.0) - key)
    return float(np.exp(np.median(exposures))) if exposures else 1.0


def exposure_of_files(paths: Sequence[Path], sample: int = 16) -> float:
    """`animation_exposure` over frames in EXR files, at most `sample` of them, equally spaced over the animation.

    Raises:
        InputError: a frame is missing or does not decode.
    """
    count = min(sample, len(paths))
    chosen = np.linspace(0, len(paths) - 1, count).round().astype(int)
    return animation_exposure(read_exr(paths[index]) for index in chosen)


def to_display(image: NDArray[np.floating], exposure: float, tone: str = "srgb") -> NDArray[np.float32]:
    """Display values in [0, 1]: exposure, a tone curve, the sRGB transfer function (IEC 61966-2-1).

    With x = exposure * value, the curve of `srgb` has a knee k = 0.6: each channel keeps x where x <= k and becomes
    k + (1 - k) (1 - exp(-(x - k) / (1 - k))) above: continuous with its slope, never clipped, and white only
    in the limit. Mid-tones therefore are plain sRGB, and windows and lamps keep their detail. `none` has no curve and
    clips x at 1. `agx` and `filmic` are Blender's (`steadylight.tone`). Images and video all use this function, so they
    look the same.

    Args:
        image: (..., 3) scene-linear RGB; negative values count as 0, NaN as 0.
        exposure: factor, from `animation_exposure`.
        tone: `agx`, `filmic`, `srgb` or `none`.

    Returns:
        (..., 3) float32 in [0, 1], sRGB-encoded.
    """
    x = np.nan_to_num(np.asarray(image, dtype=np.float32) * np.float32(exposure), nan=0.0, posinf=1e6)
    x = np.maximum(x, 0.0)
    if tone in VIEWS:
        return apply_curve(x, tone)
    if tone == "srgb":
        span = np.float32(1.0 - SHOULDER)
        x = np.where(
            x <= SHOULDER, x, SHOULDER - span * np.expm1((SHOULDER - np.maximum(x, SHOULDER)) / span)
        )
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(encoded, 0.0, 1.0), dtype=np.float32)


def tone_map(image: NDArray[np.floating], exposure: float, tone: str = "srgb") -> NDArray[np.uint8]:
    """An 8-bit sRGB version of a scene-linear image; see `to_display` for the curves.

    Args:
        image: (height, width, 3) scene-linear RGB.
        exposure: factor, from `animation_exposure`.
        tone: as in `to_display`.

    Returns:
        (height, width, 3) uint8.
    """
    return np.asarray(np.rint(to_display(image, exposure, tone) * 255.0), dtype=np.uint8)


def validate_png(path: Path) -> None:
    """Read a picture back and check that it is complete.

    Raises:
        InputError: it does not decode.
    """
    try:
        with Image.open(path) as picture:
            picture.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: is not a readable PNG image: {_last_sentence(error)}") from None


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an 8-bit sRGB image, from `tone_map`, as a PNG file.

    Args:
        path: where to write; an existing file is replaced.
        picture: (height, width, 3) uint8.

    Raises:
        StorageError: the file cannot be written.
    """
    try:
        Image.fromarray(np.ascontiguousarray(picture, dtype=np.uint8)).save(path, format="PNG")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None

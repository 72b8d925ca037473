"""Scene-linear images in OpenEXR files, read and written with the OpenEXR project's own Python package."""

from __future__ import annotations

import hashlib
import struct
from typing import TYPE_CHECKING

import numpy as np
import OpenEXR

from steadylight.errors import InputError, StorageError
from steadylight.images.scanlines import FINGERPRINT, fault_in

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray


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
        FINGERPRINT: _fingerprint(pixels),
    }
    for name, value in sorted((metadata or {}).items()):
        if name in _RESERVED or name in header:
            raise ValueError(f"metadata name {name!r} is reserved by the EXR format")
        header[name] = str(value)
    try:
        OpenEXR.File(header, {"RGB": pixels}).write(str(path))
    except (RuntimeError, OSError) as error:
        raise StorageError(f"{path}: cannot be written: {last_sentence(error)}") from None


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
    stored = opened.header().get(FINGERPRINT)
    if stored is not None and stored != _fingerprint(image):
        raise InputError(
            f"{path}: is damaged: its pixels do not match the stored hash; run the render command again, which "
            "makes it again, or restore it from a copy"
        )
    return image


def write_layers(path: Path, layers: Mapping[str, NDArray[np.floating]]) -> None:
    """Write named layers other than colours, such as depth and normals, as float32 channels of one EXR file.

    Args:
        path: where to write; an existing file is replaced.
        layers: arrays (height, width), by channel name, such as `Z`.

    Raises:
        StorageError: the file cannot be written.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(layer, dtype=np.float32) for name, layer in layers.items()}
    try:
        OpenEXR.File(header, channels).write(str(path))
    except (RuntimeError, OSError) as error:
        raise StorageError(f"{path}: cannot be written: {last_sentence(error)}") from None


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
    own = {*_RESERVED, FINGERPRINT}
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
        InputError: the file cannot be opened; the message says why.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an EXR image")
    try:
        # OpenEXR does not raise on damaged pixels but prints to the terminal, so they are checked first.
        if fault := fault_in(path, header_only=header_only):
            raise InputError(f"{path}: is {fault}")
        opened = OpenEXR.File(str(path), separate_channels=True, header_only=header_only)
    except (RuntimeError, ValueError, OSError, struct.error) as error:
        raise InputError(f"{path}: is not a readable EXR image: {last_sentence(error)}") from None
    if not opened.parts:  # pixel data that does not decompress
        raise InputError(f"{path}: is damaged: its pixels cannot be decoded")
    return opened


def last_sentence(error: Exception) -> str:
    """The error message of the library or the system, in one line."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__

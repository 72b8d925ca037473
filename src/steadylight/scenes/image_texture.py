"""Textures from image files, as entries of a scene: the encoded file, and how to interpret its texels.

An entry is a plain dict, which a renderer decodes when it builds the scene. The description therefore stays as small as
the files, and equal images are hashed, stored and sent once:

    {"type": "image",
     "encoded": (N,) uint8, the bytes of a PNG, JPEG, WebP, OpenEXR ... file, or "filename": its absolute path,
     "channels": "rgb", "r", "g", "b" or "a",
     "srgb": whether the values of rgb are decoded from sRGB,
     "gain", "bias": value becomes gain * value + bias; numbers, or lists of three,
     "threshold": if given, values below become 0, others 1 (after gain and bias),
     "power": values become 0 where negative, then value ** power,
     "wrap_mode", "filter_type", "to_uv": as for Mitsuba's `bitmap`}

Only `type`, `encoded` or `filename`, and `channels` are required.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import InputError, SceneError
from steadylight.images import read_exr, read_exr_metadata

MOST_TEXELS: Final = 1 << 28
"""16384 x 16384: more than graphics hardware supports as one texture. A small file can claim to be of any size."""

_EXR: Final = b"\x76\x2f\x31\x01"
ENVIRONMENTS: Final = {".exr": (_EXR,), ".hdr": (b"#?",), ".pfm": (b"PF", b"Pf")}
"""First bytes of the environment maps that Mitsuba reads, by file extension."""

_MODES: Final = {"r": 0, "g": 1, "b": 2, "a": 3}
_HALF: Final = 6e4
"""Larger values do not fit into 16 bits."""


def size_of(entry: Mapping[str, Any]) -> tuple[int, int]:
    """Width and height of an image, without decoding it.

    Raises:
        SceneError: it is no image that can be read.
    """
    with _opened(entry) as image:
        return int(image.width), int(image.height)


def check_environment(file: Path) -> None:
    """Check that the first bytes of an environment map match its file extension.

    Raises:
        SceneError: they do not, or the file cannot be read.
    """
    try:
        with file.open("rb") as stream:
            first = stream.read(4)
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {(error.strerror or str(error)).lower()}") from None
    suffix = file.suffix.lower()
    if not first.startswith(ENVIRONMENTS[suffix]):
        raise SceneError(f"{file}: does not begin like a {suffix} image; is it damaged?")


def is_grey(entry: Mapping[str, Any]) -> bool:
    """Whether an image has one channel besides alpha, or more than 8 bits: its values are then rarely sRGB-encoded.

    Raises:
        SceneError: it is no image that can be read.
    """
    with _opened(entry) as image:
        return image.mode in {"1", "L", "LA", "La", "F"} or image.mode.startswith("I")


def texels(entry: Mapping[str, Any]) -> NDArray[Any]:
    """The values of an image texture.

    Returns:
        (H, W, 3), or (H, W, 1) for one channel. Unmodified values stay uint8 as stored (sRGB-encoded, if `srgb`);
        others are scene-linear float16, or float32 if they do not fit into float16.

    Raises:
        SceneError: the image cannot be read.
    """
    stored = _channels(entry)
    gain = np.asarray(entry.get("gain", 1.0), dtype=np.float32)
    bias = np.asarray(entry.get("bias", 0.0), dtype=np.float32)
    threshold, power = entry.get("threshold"), float(entry.get("power", 1.0))
    changed = bool((gain != 1).any() or (bias != 0).any()) or threshold is not None or power != 1
    if stored.dtype == np.uint8 and not changed:
        return stored
    values = _linear(stored, srgb=bool(entry.get("srgb", False)))
    values *= gain
    values += bias
    if threshold is not None:
        values = (values >= threshold).astype(np.float32)
    if power != 1:
        values = np.maximum(values, 0.0) ** np.float32(power)
    small = np.abs(values).max(initial=0.0) < _HALF
    return values.astype(np.float16) if small else values


def linear_texels(entry: Mapping[str, Any]) -> NDArray[np.float32]:
    """The values of an image texture, scene-linear, (H, W, 3) or (H, W, 1)."""
    found = texels(entry)
    return (
        _linear(found, srgb=bool(entry.get("srgb", False)))
        if found.dtype == np.uint8
        else found.astype(np.float32)
    )


def as_bitmap(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An image texture as a Mitsuba `bitmap`, with its texels under `data`."""
    kept = {key: entry[key] for key in ("wrap_mode", "filter_type", "to_uv") if key in entry}
    return {"type": "bitmap", "data": linear_texels(entry), "raw": True, **kept}


def expanded(content: Mapping[str, Any]) -> dict[str, Any]:
    """Content of a scene with references to image textures replaced by the bitmaps of `as_bitmap`."""
    made: dict[str, dict[str, Any]] = {}

    def resolved(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        name = value.get("id") if value.get("type") == "ref" else None
        target = content.get(name) if isinstance(name, str) else value
        if isinstance(target, Mapping) and target.get("type") == "image":
            key = name if isinstance(name, str) else ""
            if not key or key not in made:
                made[key] = as_bitmap(target)
            return made[key]
        return {key: resolved(item) for key, item in value.items()}

    named = {key: entry for key, entry in content.items() if not _is_image(entry)}
    return {key: resolved(entry) for key, entry in named.items()}


def _is_image(entry: Any) -> bool:
    return isinstance(entry, Mapping) and entry.get("type") == "image"


def _opened(entry: Mapping[str, Any]) -> Any:
    """The image, opened with Pillow, after checking its size."""
    from PIL import Image, UnidentifiedImageError

    encoded = entry.get("encoded")
    source = (
        Path(entry["filename"]) if encoded is None else io.BytesIO(np.asarray(encoded, np.uint8).tobytes())
    )
    name = entry.get("filename", "image within the scene file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns about large images, and about harmless oddities
            image = Image.open(source)
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise SceneError(f"{name}: cannot be read as an image ({_reason(error)})") from None
    if image.width * image.height > MOST_TEXELS:
        image.close()
        raise SceneError(
            f"{name}: has {image.width} x {image.height} pixels; at most {MOST_TEXELS:,} are supported: scale it down"
        )
    return image


def _reason(error: Exception) -> str:
    return str(error).split("<")[0].strip() or type(error).__name__


def exr_texels(source: NDArray[np.uint8] | str) -> NDArray[np.float32] | None:
    """The pixels of an OpenEXR file (bytes, or its path), scene-linear, (H, W, 3); None for another kind of file.

    Raises:
        InputError: the file is damaged.
    """
    if isinstance(source, str):
        try:
            with Path(source).open("rb") as stream:
                first = stream.read(4)
        except OSError:
            return None  # Pillow reports why
        return _exr(Path(source)) if first == _EXR else None
    if source[:4].tobytes() != _EXR:
        return None
    with TemporaryDirectory(prefix="steadylight-") as folder:
        file = Path(folder) / "image.exr"
        file.write_bytes(source.tobytes())
        return _exr(file)


def _exr(file: Path) -> NDArray[np.float32]:
    """An EXR image, decoded if it is marked as sRGB, as are those that Blender makes from sRGB images."""
    image = read_exr(file)
    encoded = read_exr_metadata(file).get("colorInteropID", "").startswith("srgb_rec709_display")
    return _decoded(image) if encoded else image


def _channels(entry: Mapping[str, Any]) -> NDArray[Any]:
    """The channels that an entry names, uint8 or scene-linear float32, (H, W, 1) or (H, W, 3)."""
    which = entry["channels"]
    try:
        high = exr_texels(
            entry["filename"] if entry.get("encoded") is None else np.asarray(entry["encoded"], np.uint8)
        )
    except InputError as error:
        raise SceneError(f"{entry.get('filename', 'image within the scene file')}: {error}") from None
    if high is not None:
        if which == "rgb":
            return high
        return np.ones_like(high[..., :1]) if which == "a" else high[..., _MODES[which]][..., None]
    with _opened(entry) as image:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if image.mode in {"I", "I;16", "I;16B", "I;16L", "F"}:  # one channel of more than 8 bits
                    grey = np.asarray(image, dtype=np.float32) / np.float32(1 if image.mode == "F" else 65535)
                    alone = np.ones_like(grey) if which == "a" else grey
                    return np.repeat(alone[..., None], 3, axis=2) if which == "rgb" else alone[..., None]
                full = np.array(image.convert("RGB" if which == "rgb" else "RGBA"))
        except (OSError, ValueError, SyntaxError, EOFError, OverflowError) as error:
            name = entry.get("filename", "image within the scene file")
            raise SceneError(f"{name}: the image is damaged ({_reason(error)})") from None
    return np.ascontiguousarray(full if which == "rgb" else full[..., _MODES[which]][..., None])


def _linear(values: NDArray[Any], *, srgb: bool) -> NDArray[np.float32]:
    """Stored values as scene-linear float32."""
    if values.dtype != np.uint8:
        encoded = np.array(values, dtype=np.float32)
        return _decoded(encoded) if srgb else encoded
    table = np.arange(256, dtype=np.float32) / np.float32(255)
    return np.asarray((_decoded(table) if srgb else table)[values])


def _decoded(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Linear values of sRGB (IEC 61966-2-1)."""
    low = values <= 0.04045
    return np.where(low, values / 12.92, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )

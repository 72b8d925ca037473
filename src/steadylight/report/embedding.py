"""Building blocks of all pages: templates, one style, and pictures and data embedded in the page."""

from __future__ import annotations

import base64
import io
import json
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from PIL import Image

if TYPE_CHECKING:
    from numpy.typing import NDArray


def page_from(template: str, **values: Any) -> str:
    """Fill a template of this package; templates may include its style sheets, scripts and vendored files."""
    environment = Environment(
        loader=FunctionLoader(text_of),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["verbatim"] = text_of
    return environment.get_template(template).render(**values)


def text_of(name: str) -> str:
    """The text of a file of this package."""
    place = resources.files("steadylight.report")
    for part in name.split("/"):
        place = place.joinpath(part)
    return place.read_text(encoding="utf-8")


def as_json(value: Any) -> str:
    """Plain data as JSON for a script element, escaped so that nothing in it can end that element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def jpeg(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """An image, (height, width) or (height, width, 3), as JPEG with full colour resolution."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, format="JPEG", quality=quality, subsampling=0)
    return content.getvalue()


def resized(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """A smaller version of an image."""
    if pixels.shape[:2] == (height, width):
        return pixels
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))


def text(content: bytes) -> str:
    """Bytes as base64."""
    return base64.b64encode(content).decode("ascii")


def data_url(kind: str, content: bytes) -> str:
    """Bytes as a data URL."""
    return f"data:{kind};base64,{text(content)}"

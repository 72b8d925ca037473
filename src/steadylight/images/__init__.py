"""Images: scene-linear float RGB in OpenEXR files, and 8-bit images made from them with one exposure.

An image is an array (height, width, 3) of float32, scene-linear RGB with Rec. 709 primaries and a D65 white, row 0 at
the top. Nothing here uses Mitsuba, whose bitmaps need a process-wide variant.
"""

from __future__ import annotations

from steadylight.images.display import (
    LUMINANCE_WEIGHTS,
    MIDDLE_GREY,
    SHOULDER,
    animation_exposure,
    exposure_of_files,
    luminance,
    to_display,
    tone_map,
    validate_png,
    write_png,
)
from steadylight.images.exr import (
    read_exr,
    read_exr_metadata,
    read_layers,
    validate_exr,
    write_exr,
    write_layers,
)

__all__ = [
    "LUMINANCE_WEIGHTS",
    "MIDDLE_GREY",
    "SHOULDER",
    "animation_exposure",
    "exposure_of_files",
    "luminance",
    "read_exr",
    "read_exr_metadata",
    "read_layers",
    "to_display",
    "tone_map",
    "validate_exr",
    "validate_png",
    "write_exr",
    "write_layers",
    "write_png",
]

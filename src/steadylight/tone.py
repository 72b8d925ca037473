"""Established tone curves, from Blender's OpenColorIO configuration: AgX and Filmic.

OpenColorIO's built-in configurations have the curves of ACES only. The package `simple-ocio` carries Blender's
configuration unchanged; its files are read here with OpenColorIO itself.
"""

from __future__ import annotations

import functools
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from steadylight.errors import RunError

if TYPE_CHECKING:
    from numpy.typing import NDArray

VIEWS: Final = {"agx": "AgX", "filmic": "Filmic"}
"""Views of the configuration, by the value of `--tone`."""

_LARGEST: Final = 1e6
"""Larger values are shown like this one: the tables of the curves do not expect infinity."""


def apply_curve(values: NDArray[np.float32], tone: str) -> NDArray[np.float32]:
    """Apply a tone curve.

    Args:
        values: (..., 3) scene-linear RGB, exposed, Rec. 709 primaries, without NaN.
        tone: a key of VIEWS.

    Returns:
        (..., 3) in [0, 1], sRGB-encoded.

    Raises:
        RunError: the configuration cannot be read.
    """
    pixels = np.array(np.clip(values, 0.0, _LARGEST), dtype=np.float32, order="C").reshape(-1, 3)
    _processor(tone).applyRGB(pixels)
    return np.clip(pixels, 0.0, 1.0).reshape(values.shape)


@functools.lru_cache(maxsize=len(VIEWS))
def _processor(tone: str) -> Any:
    import PyOpenColorIO

    file = resources.files("simple_ocio") / "ocio_data" / "config.ocio"
    try:
        config = PyOpenColorIO.Config.CreateFromFile(str(file))
        view = PyOpenColorIO.DisplayViewTransform(src="Linear Rec.709", display="sRGB", view=VIEWS[tone])
        return config.getProcessor(view).getDefaultCPUProcessor()
    except PyOpenColorIO.Exception as error:
        raise RunError(
            f"--tone {tone}: OpenColorIO cannot use Blender's configuration {file} ({error}); "
            "install simple-ocio again, or choose another tone"
        ) from error

"""Values in a camera path: checked numbers and vectors, and how messages describe them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import CameraError

Vector = tuple[float, float, float]
Array = NDArray[np.float64]

LARGEST: Final = 1e12
"""Maximum magnitude of a number in a path: squares of larger ones are not exact, or not finite."""


def checked_number(name: str, value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise CameraError(f"`{name}` must be a number, not {kind_of(value)}")
    try:
        finite = float(value)
    except OverflowError:
        finite = math.inf
    if not math.isfinite(finite):
        raise CameraError(f"`{name}` is {finite}; it must be a finite number")
    if abs(finite) > LARGEST:
        raise CameraError(f"`{name}` is {finite:g}; it must be within {LARGEST:g} of 0")
    return finite


def checked_vector(name: str, value: Any) -> Vector:
    """Three finite numbers."""
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 3:
        raise CameraError(f"`{name}` must be three numbers [x, y, z], not {kind_of(value)}")
    x, y, z = (checked_number(name, item) for item in value)
    return x, y, z


def kind_of(value: Any) -> str:
    """A description of a value for messages."""
    if isinstance(value, list | tuple | np.ndarray):
        return f"a list of {len(value)}"
    if isinstance(value, Mapping):
        return "a table"
    return repr(value)

"""Arrays from the host to the device, copied into memory of Dr.Jit's own, and back.

An array made from NumPy's may stay where it was. There a kernel reads it as packets, which may run past its end into
a page that is not ours and end the process; and whether it is aligned changes the kernel, so that each array would
have one of its own. Fetched element by element, neither can happen.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def upload(kind: Any, array: NDArray[Any]) -> Any:
    """A flat array as `kind`, mi.Float, mi.UInt32 or mi.Bool; or (P, k) rows as a vector type of k components.

    Args:
        kind: type of the result.
        array: (P,) or (P, k).
    """
    if array.ndim == 1:
        mapped = kind(np.ascontiguousarray(array))
        copy = dr.gather(kind, mapped, dr.arange(mi.UInt32, len(array)) + dr.opaque(mi.UInt32, 0))
    else:
        copy = kind(*(upload(mi.Float, column) for column in array.astype(np.float32).T))
    dr.eval(copy)
    return copy


def download(array: Any) -> NDArray[Any]:
    """A flat array as (P,); or a vector as (P, k) rows.

    Component by component: Dr.Jit would compile a kernel for each number of rows that a whole vector has.
    """
    if dr.depth_v(array) == 1:
        return np.array(array)
    return np.stack([np.array(component) for component in array], axis=1)

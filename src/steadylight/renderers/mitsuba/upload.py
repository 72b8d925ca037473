"""Arrays from the host to the device, copied into memory that Dr.Jit allocates, and back.

An array made from a NumPy array may share its memory. Kernels read it in packets, which may run past its end into an
unmapped page and crash the process; and its alignment changes the kernel, so that each array could need a kernel of its
own. Copying it avoids both.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def upload(kind: Any, array: NDArray[Any]) -> Any:
    """Upload a flat array as `kind`: mi.Float, mi.UInt32 or mi.Bool; or (P, k) rows as a vector type of k components.

    Args:
        kind: type of the result.
        array: (P,) or (P, k).
    """
    if array.ndim == 1:
        if len(array) == 0 or mi.variant().startswith("cuda"):
            return kind(np.ascontiguousarray(array))
        copy = dr.empty(kind, len(array))
        np.asarray(copy)[:] = array  # a view of its memory
        return copy
    return kind(*(upload(mi.Float, column) for column in array.astype(np.float32).T))


def download(array: Any) -> NDArray[Any]:
    """Download a flat array as (P,), or a vector as (P, k) rows.

    Evaluated as a whole, in one kernel, but copied component by component: to copy a whole vector, Dr.Jit would compile
    a kernel for each number of rows.
    """
    if dr.depth_v(array) == 1:
        return np.array(array)
    dr.eval(array)
    return np.stack([np.array(component) for component in array], axis=1)

"""Bounds of memory on the device.

Each is a constant, so that how work is split does not depend on the machine: it decides the last bit of sums, and which
pixels lie around one where noise and fireflies are judged, which is done in bands of rows and passes of samples.
"""

from __future__ import annotations

PATHS_AT_ONCE = 1 << 21
"""Paths of the gather, and shadow rays towards emitters, in one launch."""

SAMPLES_AT_ONCE = 1 << 24
"""Camera samples of an image in one launch."""

SPP_AT_ONCE = 64
"""More samples per pixel than this are taken in passes of equal size."""

MISSES_AT_ONCE = 1 << 20
"""Points without an answer that are noted at once; if there are more, they are looked for again with room for all."""

RECORDINGS = 64
"""Frozen kernels kept at most, of one function: one for each scene, cache and kind of samples."""

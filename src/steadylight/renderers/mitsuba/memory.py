"""Limits on device memory.

They are constants, so that the way work is split does not depend on the machine. The split affects the last bit of
sums, and which pixels count as neighbours in judging noise and fireflies, which is done per band of rows and pass of
samples.
"""

from __future__ import annotations

PATHS_AT_ONCE = 1 << 21
"""Paths of the gather, or shadow rays towards emitters, per launch."""

SAMPLES_AT_ONCE = 1 << 24
"""Camera samples of an image per launch."""

SPP_AT_ONCE = 64
"""With more samples per pixel than this, they are taken in passes of equal size."""

MISSES_AT_ONCE = 1 << 20
"""Misses recorded at once; if there are more, the search is repeated with room for all."""

POINTS_AT_ONCE = 1 << 21
"""Look-up points of several frames that are thinned together, unless a single frame has more."""

RECORDINGS = 64
"""Maximum number of frozen kernels of one function: one for each scene, cache and kind of samples."""

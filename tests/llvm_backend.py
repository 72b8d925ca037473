"""The backend of every test here; it must be chosen before Mitsuba is imported anywhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from steadylight.renderers.mitsuba.backend import use_variant

if TYPE_CHECKING:
    from collections.abc import Iterator

use_variant("llvm_ad_rgb")


@pytest.fixture(autouse=True, scope="module")
def _llvm() -> Iterator[None]:
    """LLVM on all cores, whatever a test before left."""
    import drjit as dr

    use_variant("llvm_ad_rgb")
    history = dr.flag(dr.JitFlag.KernelHistory)
    yield
    dr.set_flag(dr.JitFlag.KernelHistory, history)
    use_variant("llvm_ad_rgb")

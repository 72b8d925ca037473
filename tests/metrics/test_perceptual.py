"""JOD: equal films are perfect, flicker is worse than the same error standing still, and refusals are in words."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest

from steadylight.errors import BackendError, InputError
from steadylight.metrics.perceptual import jod


def film(*levels: float) -> list[np.ndarray]:
    return [np.full((48, 64, 3), level, np.float32) for level in levels]


def test_films_of_other_lengths_or_sizes_are_refused() -> None:
    with pytest.raises(InputError, match="films of 2 and 3 frames"):
        jod(film(0.1, 0.1), film(0.1, 0.1, 0.1), 25.0, 1.0)
    with pytest.raises(InputError, match="cannot be compared"):
        jod(film(0.1), [np.zeros((4, 4, 3))], 25.0, 1.0)


def test_a_missing_package_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("steadylight.metrics.perceptual._load_torchvision", lambda: None)
    monkeypatch.setitem(sys.modules, "pycvvdp", None)
    with pytest.raises(BackendError, match=r"pip install 'steadylight\[perceptual\]'"):
        jod(film(0.1), film(0.1), 25.0, 1.0)


@pytest.mark.filterwarnings("ignore")  # of torch, about itself
def test_equal_films_are_perfect_and_flicker_is_seen() -> None:
    if find_spec("pycvvdp") is None:
        pytest.skip("pip install cvvdp")
    steady = film(*[0.2] * 6)
    assert jod(steady, steady, 25.0, 1.0) == pytest.approx(10.0)
    assert jod(film(0.24, 0.16, 0.24, 0.16, 0.24, 0.16), steady, 25.0, 1.0) < 9.0

"""How different two films look to a person: ColorVideoVDP, in just-objectionable-difference units (JOD).

Mantiuk, Hanji, Ashraf, Asano and Chapiro 2024, "ColorVideoVDP: A visual difference predictor for image, video and
display distortions", doi:10.1145/3658144, computed with the authors' package `cvvdp` (the extra `perceptual`). It
models how the eye sees contrast, colour and flicker. 10 JOD is no visible difference; a film that is 1 JOD worse than
another is found worse by three viewers out of four.
"""

from __future__ import annotations

import contextlib
import io
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.errors import BackendError, InputError
from steadylight.images import to_display

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

DISPLAY = "standard_fhd"
"""Display model of the package: a 24-inch Full HD monitor, 200 cd/m², seen from 60 cm."""


def jod(
    film: Sequence[NDArray[np.floating]],
    reference: Sequence[NDArray[np.floating]],
    fps: float,
    exposure: float,
) -> float:
    """Quality of a film against a reference without noise.

    Args:
        film: frames, (height, width, 3) scene-linear RGB.
        reference: as many frames of the same size.
        fps: frames per second at which both are watched.
        exposure: factor on scene-linear values, for both.

    Returns:
        At most 10.

    Raises:
        InputError: the films differ in length or size.
        BackendError: the package is not installed, or cannot be loaded.
    """
    shapes = {np.shape(frame) for frame in (*film, *reference)}
    if len(film) != len(reference) or len(shapes) != 1:
        raise InputError(
            f"films of {len(film)} and {len(reference)} frames with sizes {sorted(shapes)} cannot be compared; both "
            "need the same frames"
        )
    metric = _metric()
    test, truth = (np.stack([to_display(np.asarray(f), exposure) for f in x]) for x in (film, reference))
    with contextlib.redirect_stderr(io.StringIO()):  # its progress bar
        value, _ = metric.predict(test, truth, dim_order="FHWC", frames_per_second=fps)
    return float(value)


def _metric() -> Any:
    try:
        _load_torchvision()
        import pycvvdp
        import torch
    except (ImportError, RuntimeError, OSError) as error:
        raise BackendError(
            f"JOD needs ColorVideoVDP, which cannot be loaded ({error}): pip install 'steadylight[perceptual]'"
        ) from error
    return pycvvdp.cvvdp(display_name=DISPLAY, device=torch.device("cpu"), quiet=True)


def _load_torchvision() -> None:
    """Load torchvision, whose blur the metric uses, even if it was built for a GPU and torch was not.

    In such a pair, torchvision's compiled operators are missing, but its Python part needs their names on import.
    """
    try:
        import torchvision
    except RuntimeError:
        import torch

        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        operators = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _kept.append(operators)
        import torchvision  # noqa: F401


_kept: list[Any] = []  # operators vanish with their library object

"""Rough cost of a run before it begins: time, memory, disk space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from steadylight.animation.plan import audit_rounds
from steadylight.renderers.base import Capabilities
from steadylight.settings import RenderSettings


@dataclass(frozen=True)
class Cost:
    """Estimated work of a run, as far as the settings determine it.

    Attributes:
        camera_samples: pixel samples of all frames of the second pass.
        first_pass_rays: minimum number of first-pass rays (base rays of each selected frame); 0 without a first pass.
        audited_frames: frames of the coverage audit, counted once per round; 0 without an audit.
        seconds_cpu: CPU seconds of both passes, summed over all cores, if rendered on a CPU.
        probed: whether `seconds_cpu` is based on a probe of the scene; otherwise it is that of a plain room.
        memory: bytes that each worker needs.
        disk: bytes of the frames.
    """

    camera_samples: int
    first_pass_rays: int
    audited_frames: int
    seconds_cpu: float
    probed: bool
    memory: int
    disk: int


def estimate_cost(
    settings: RenderSettings, selected: Sequence[int], can: Capabilities, probed: float | None = None
) -> Cost:
    """Rough cost of a run; the number of records is known only after the first pass.

    Args:
        settings: settings of the run.
        selected: frames that the first pass visits.
        can: what the renderer can do.
        probed: result of `ProbingRenderer.probe`; None without a probe, or if it cannot tell.
    """
    frames, pixels = len(settings.frames), settings.width * settings.height
    a_sample = _SECONDS_PATH if settings.mode == "path" else can.seconds_per_sample
    traced = frames * a_sample * pixels * settings.spp if probed is None else probed
    return Cost(
        camera_samples=pixels * frames * settings.spp,
        first_pass_rays=settings.base_rays * len(selected) if settings.mode == "two-pass" else 0,
        audited_frames=frames * audit_rounds(settings, can),
        seconds_cpu=_SECONDS_START + frames * _SECONDS_FRAME + traced,
        probed=probed is not None,
        memory=int(_BYTES_START + _BYTES_SAMPLE * min(pixels * settings.spp, _SAMPLES_AT_ONCE)),
        disk=int(_BYTES_PIXEL * pixels * frames),
    )


# Measured on two cores: gallery and temple-walk at 64x48 to 640x480, and the times in docs/quality.md.
_SECONDS_START: Final = 12.0
_SECONDS_FRAME: Final = 1.0
_SECONDS_PATH: Final = 1.1e-6
_BYTES_START: Final = 0.5e9
_BYTES_SAMPLE: Final = 134.0
_SAMPLES_AT_ONCE: Final = 1 << 24
_BYTES_PIXEL: Final = 11.5

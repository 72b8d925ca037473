"""Run directories made by hand, for tests of pages about them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.checksum import with_checksum
from steadylight.images import write_exr

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def record_of(frames: list[int], size: tuple[int, int], mode: str = "two-pass") -> dict[str, Any]:
    """Content of `run.json` of a film of a standing camera."""
    key = {"time": 0.0, "origin": [0, 0, 0], "target": [0, 1, 0], "up": [0, 0, 1], "fov": 60.0}
    return {
        "format": 3,
        "scene": {"name": "room", "title": "a <room>", "hash": "f" * 64, "source": "room"},
        "settings": {
            "frames": frames,
            "width": size[0],
            "height": size[1],
            "fps": 25.0,
            "mode": mode,
            "spp": 16,
            "denoise": True,
            "quality": 1.0,
        },
        "camera": {"keyframes": [key], "loop": False},
        "selected": [frames[0]],
        "variant": "llvm_ad_rgb",
        "versions": {"steadylight": "0.1.0"},
        "host": {},
    }


def write_run(
    root: Path,
    frames: list[int],
    images: Callable[[int], np.ndarray],
    *,
    mode: str = "two-pass",
    wanted: int = 0,
) -> Path:
    """A finished run directory of a standing camera, or one that lacks frames up to `wanted`."""
    (root / "frames").mkdir(parents=True)
    size = (0, 0)
    for number in frames:
        image = images(number)
        size = (image.shape[1], image.shape[0])
        write_exr(root / "frames" / f"frame_{number:05d}.exr", image)
    numbers = frames if not wanted else list(range(1, wanted + 1))
    (root / "run.json").write_text(json.dumps(with_checksum(record_of(numbers, size, mode))))
    if not wanted:
        statistics = {
            "makespan_s": 75.0,
            "frames": len(frames),
            "workers": 2,
            "selected_frames": [frames[0]],
            "first_pass": {"seconds": 20.0, "seconds_cpu": 38.0},
            "merge": {"records_out": 1000, "seconds_cpu": 3.0},
            "coverage": {"seconds": 12.0, "seconds_cpu": 24.0, "records": 50},
            "second_pass": {"seconds": 30.0, "seconds_cpu": 55.0, "missed": 0},
            "tasks": {"done": 9, "attempts": 10, "failed": 0, "lost": 1},
        }
        (root / "stats.json").write_text(json.dumps(with_checksum(statistics)))
    return root


def flickering(strength: float, height: int = 36, width: int = 48) -> Callable[[int], np.ndarray]:
    """Frames of a standing camera whose left half gets brighter and darker, each frame with a mark of its number."""

    def image(number: int) -> np.ndarray:
        pixels = np.full((height, width, 3), 0.2, np.float32)
        pixels[:, : width // 2] *= 1 + strength * (-1) ** number
        pixels[-4:, :] = 0.05 * (number % 8)
        return pixels

    return image

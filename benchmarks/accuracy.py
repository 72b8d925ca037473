"""Error of a run against two independent path-traced runs of the same frames.

    python benchmarks/accuracy.py RUN REFERENCE_A REFERENCE_B [--picture out.png]

Frames that a reference lacks are left out. The two references differ in their seed only. Errors exclude
their noise, as those of `steadylight compare --reference A --reference-b B` (`metrics/still.py`). Plain rel_rmse and
rel_bias against the mean of both are printed beside them, and the noise of that mean. The last columns are the numbers
of blocks of 24x24 pixels that are too bright or too dark: by more than 2 %, and by more than twice the noise of the
references there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from steadylight.images import read_exr, tone_map, write_png
from steadylight.metrics.blocks import Grid
from steadylight.metrics.still import errors_against, rel_bias, rel_rmse

BLOCK = 24
"""Edge of a block, pixels."""

PARTS = 6
"""Parts of a block along each axis, by whose differences the noise of the references is judged. The reconstruction
filter correlates neighbours: by these parts, the noise comes out about a tenth too low, by single pixels two fifths."""

OFF = 0.02
"""Relative error of a block above which it is too bright or too dark."""

COLUMNS = ("rel_rmse", "rel_bias", "plain_rmse", "plain_bias", "reference_noise")
BLOCKS = ("bright", "dark")


def main() -> None:
    """Print a line for each frame and one for all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("references", type=Path, nargs=2)
    parser.add_argument(
        "--picture", type=Path, help="PNG: run, reference, error from -10 %% (dark) to +10 %% (light)"
    )
    options = parser.parse_args()
    rows = []
    print(
        f"{'frame':18}"
        + "".join(f"{name:>17}" for name in COLUMNS)
        + "".join(f"{name:>8}" for name in BLOCKS)
    )
    for path in sorted((options.run / "frames").glob("frame_*.exr")):
        image = read_exr(path)
        others = [reference / "frames" / path.name for reference in options.references]
        if not all(other.exists() for other in others):
            continue
        a, b = map(read_exr, others)
        row = measure(image, a, b)
        rows.append(row)
        errors = "".join(f"{row[name]:17.4f}" for name in COLUMNS)
        print(f"{path.name:18}" + errors + "".join(f"{row[name]:8}" for name in BLOCKS))
        if options.picture and len(rows) == 1:
            draw(options.picture, image, (a + b) / 2)
    if not rows:
        parser.error(f"no frame of {options.run} is in both references")
    means = {name: float(np.mean([row[name] for row in rows])) for name in (*COLUMNS, *BLOCKS)}
    print(json.dumps({"frames": len(rows)} | means))


def measure(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Errors of (H, W, 3) scene-linear `image` against references `a` and `b`."""
    errors, reference = errors_against(image, a, b), (a + b) / 2
    bright, dark = blocks_off(image, a, b)
    return {
        "rel_rmse": errors.rel_rmse,
        "rel_bias": errors.rel_bias,
        "plain_rmse": float(rel_rmse(image, reference)),
        "plain_bias": float(rel_bias(image, reference)),
        "reference_noise": errors.noise,
        "bright": bright,
        "dark": dark,
    }


def blocks_off(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[int, int]:
    """Numbers of blocks that are too bright and too dark.

    The noise of the references' mean in a block follows from their differences in parts of it.
    """
    height, width, _ = image.shape
    grid = Grid(width, height, BLOCK)
    reference = grid.sums((a + b) / 2)
    parts = Grid(width, height, BLOCK // PARTS)
    variance = np.square(parts.sums((a - b) / 2))
    noise = np.sqrt(Grid(parts.columns, parts.rows, PARTS).sums(variance[..., None].repeat(3, axis=2)))
    error = grid.sums(image) - reference
    off = np.abs(error) > np.maximum(OFF * reference, 2 * noise)
    return int((off & (error > 0)).sum()), int((off & (error < 0)).sum())


def draw(path: Path, image: np.ndarray, reference: np.ndarray) -> None:
    """Run, reference and signed relative error side by side."""
    exposure = float(0.35 / np.median(reference))
    error = (image - reference) / (reference + 0.1 * reference.mean())
    grey = np.clip(128 + 1280 * error, 0, 255).astype(np.uint8)
    write_png(path, np.concatenate([tone_map(image, exposure), tone_map(reference, exposure), grey], axis=1))


if __name__ == "__main__":
    main()

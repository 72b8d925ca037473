"""Error of a run against two independent path-traced runs of the same frames.

    python benchmarks/accuracy.py RUN REFERENCE_A REFERENCE_B [--picture out.png]

Frames that a reference lacks are left out. The two references differ in their seed only. With r_A and r_B the
relative errors against each (design: the ratio of the difference to reference + a tenth of the mean reference), the
mean of r_A * r_B is the squared error of RUN without the noise of the references, since their noises are independent:
what a reference of infinitely many samples would give. Both are divided by a smoothed reference: the noise of a
pixel in its own divisor would count as error and, being more often divided by too little, as bias (a reference of
10 % noise shows 1 % bias, and one of 20 % shows 4 %). Plain rel_rmse and rel_bias against the mean of both, by the
metric of `steadylight compare`, are printed beside them, and the references' own noise.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter

from steadylight.images import read_exr, tone_map, write_png
from steadylight.metrics.still import rel_bias, rel_rmse

SMOOTHED = 9
"""Pixels over which the divisor of the relative error is averaged, in each direction."""


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
    names = ("rel_rmse", "rel_bias", "plain_rmse", "plain_bias", "reference_noise")
    print(f"{'frame':18}" + "".join(f"{name:>17}" for name in names))
    for path in sorted((options.run / "frames").glob("frame_*.exr")):
        image = read_exr(path)
        others = [reference / "frames" / path.name for reference in options.references]
        if not all(other.exists() for other in others):
            continue
        a, b = map(read_exr, others)
        row = measure(image, a, b) | {"frame": path.name}
        rows.append(row)
        print(f"{path.name:18}" + "".join(f"{row[name]:17.4f}" for name in names))
        if options.picture and len(rows) == 1:
            draw(options.picture, image, (a + b) / 2)
    if not rows:
        parser.error(f"no frame of {options.run} is in both references")
    means = {name: float(np.mean([row[name] for row in rows])) for name in names}
    print(json.dumps({"frames": len(rows)} | means))


def measure(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Errors of (H, W, 3) scene-linear `image` against references `a` and `b`."""
    reference = (a + b) / 2
    scale = uniform_filter(reference, (SMOOTHED, SMOOTHED, 0)) + 0.1 * reference.mean()
    product = ((image - a) / scale) * ((image - b) / scale)
    return {
        "rel_rmse": float(np.sqrt(max(0.0, float(product.mean())))),
        "rel_bias": float(((image - reference) / scale).mean()),
        "plain_rmse": float(rel_rmse(image, reference)),
        "plain_bias": float(rel_bias(image, reference)),
        "reference_noise": float(np.sqrt((((a - b) / 2 / scale) ** 2).mean())),
    }


def draw(path: Path, image: np.ndarray, reference: np.ndarray) -> None:
    """Run, reference and signed relative error side by side."""
    exposure = float(0.35 / np.median(reference))
    error = (image - reference) / (reference + 0.1 * reference.mean())
    grey = np.clip(128 + 1280 * error, 0, 255).astype(np.uint8)
    write_png(path, np.concatenate([tone_map(image, exposure), tone_map(reference, exposure), grey], axis=1))


if __name__ == "__main__":
    main()

"""Error of a run against two independent path-traced runs of the same frames.

    python benchmarks/accuracy.py RUN REFERENCE_A REFERENCE_B [--picture out.png]

Frames that a reference lacks are left out. The two references differ in their seed only. With r_A and r_B the
relative errors against each (design: the ratio of the difference to reference + a tenth of the mean reference), the
mean of r_A * r_B is the squared error of RUN without the noise of the references, since their noises are independent:
what a reference of infinitely many samples would give. Plain rel_rmse against the mean of both is printed beside it,
and the references' own noise.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from steadylight.images import read_exr, tone_map, write_png
from steadylight.metrics.still import rel_bias, rel_rmse


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
    print(f"{'frame':22} {'rel_rmse':>9} {'plain':>9} {'rel_bias':>9} {'reference noise':>16}")
    for path in sorted((options.run / "frames").glob("frame_*.exr")):
        image = read_exr(path)
        others = [reference / "frames" / path.name for reference in options.references]
        if not all(other.exists() for other in others):
            continue
        a, b = map(read_exr, others)
        row = measure(image, a, b) | {"frame": path.name}
        rows.append(row)
        print(
            f"{path.name:22} {row['rel_rmse']:9.4f} {row['plain']:9.4f} {row['rel_bias']:9.4f} "
            f"{row['reference_noise']:16.4f}"
        )
        if options.picture and len(rows) == 1:
            draw(options.picture, image, (a + b) / 2)
    if not rows:
        parser.error(f"no frame of {options.run} is in both references")
    print(
        json.dumps(
            {"frames": len(rows)}
            | {key: float(np.mean([row[key] for row in rows])) for key in ("rel_rmse", "plain", "rel_bias")}
        )
    )


def measure(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Errors of (H, W, 3) scene-linear `image` against references `a` and `b`."""
    reference = (a + b) / 2
    scale = reference + 0.1 * reference.mean()
    product = ((image - a) / scale) * ((image - b) / scale)
    return {
        "rel_rmse": float(np.sqrt(max(0.0, float(product.mean())))),
        "plain": float(rel_rmse(image, reference)),
        "rel_bias": float(rel_bias(image, reference)),
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

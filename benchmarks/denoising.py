"""A standing camera with and without `--denoise`: time, error and flicker.

    python benchmarks/denoising.py [--scenes gallery temple-walk] [--size 256x144] [--quality normal] [--frames 8]
        [--films 16 16d 8d] [--bounces auto] [--reference-spp 1024] [--folder FOLDER] [--pictures FOLDER]

A scene is a bundled name, or `FILE,CAMERA` for a scene file and its camera. The camera stands where it is in the middle
of the scene's own film; frames differ in their random numbers only. A film of `--films` is a number of samples per
pixel, with `d` if it is denoised. All films of a scene have the same records.

- seconds a frame: CPU seconds, median of the second-pass tasks but the first, which compiles the kernels.
- rel_rmse, rel_bias: means over the frames, by `measure` of accuracy.py, against two path references of other seeds.
- static deviation: how much a pixel changes from frame to frame; brightness deviation: how much the mean of the
  picture does, over that mean.

What is in FOLDER already is not rendered again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from accuracy import measure
from provenance import provenance
from rivals import standing
from versions import frame_cpu, tasks_done

import steadylight as sl
from steadylight.images import read_exr, tone_map, write_png
from steadylight.metrics.temporal import brightness_series, static_deviation
from steadylight.renderers.mitsuba.backend import resolve_variant


def main() -> None:
    """Measure scene by scene and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["gallery", "temple-walk"])
    parser.add_argument("--size", default="256x144")
    parser.add_argument("--quality", default="normal")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--films", nargs="+", default=["16", "16d", "8d"])
    parser.add_argument("--bounces", default="auto", help="indirect diffuse bounces")
    parser.add_argument("--reference-spp", type=int, default=1024, help="of each of the two references")
    parser.add_argument("--folder", type=Path, help="where the runs go; a temporary one if not given")
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="plain, denoised and reference, as PNG"
    )
    options = parser.parse_args()
    sl.use_variant(resolve_variant("auto"))
    print(json.dumps(provenance()))
    with tempfile.TemporaryDirectory(prefix="denoising-") as temporary:
        for name in options.scenes:
            measure_scene(name, options, options.folder or Path(temporary))


def measure_scene(name: str, options: argparse.Namespace, folder: Path) -> None:
    """Print a line for each film."""
    source, _, camera = name.partition(",")
    request = sl.plan(source, camera=camera or None)
    middle = request.settings.frames[len(request.settings.frames) // 2]
    (pose,) = request.scene.camera.frame_poses([middle], request.settings.fps)
    folder /= Path(source).resolve().parent.name if camera else source
    film = {
        "camera": standing(pose, options.frames / request.settings.fps),
        "size": options.size,
        "fps": request.settings.fps,
        "bounces": options.bounces if options.bounces == "auto" else int(options.bounces),
        "cluster": "in-process",
    }
    path = {**film, "frames": 1, "mode": "path", "spp": options.reference_spp}
    references = [
        read_exr(sl.render(source, seed=seed, output=folder / f"path-{seed}", **path).frames[0])
        for seed in (101, 102)
    ]
    reference = np.mean(references, axis=0)
    pictures = {}
    for kind in options.films:
        run = sl.render(
            source,
            frames=options.frames,
            quality=options.quality,
            spp=int(kind.removesuffix("d")),
            denoise=kind.endswith("d"),
            output=folder / kind,
            **film,
        )
        images = [read_exr(frame) for frame in run.frames]
        pictures[kind] = images[0]
        errors = [measure(image, *references) for image in images]
        row = {
            "scene": folder.name,
            "film": kind,
            "seconds_a_frame": frame_cpu(
                [line for line in tasks_done(folder / kind) if line["stage"] == "shade"]
            ),
            **{
                key: float(np.mean([error[key] for error in errors]))
                for key in ("rel_rmse", "rel_bias", "reference_noise")
            },
            "static_deviation": static_deviation(images, reference),
            "brightness_deviation": float(np.std(brightness_series(images))),
        }
        rounded = {key: value if isinstance(value, str) else round(value, 6) for key, value in row.items()}
        print(json.dumps(rounded), flush=True)
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        exposure = float(0.35 / np.median(reference))
        for kind, image in {**pictures, "path": reference}.items():
            write_png(options.pictures / f"{folder.name}-{kind}.png", tone_map(image, exposure))


if __name__ == "__main__":
    main()

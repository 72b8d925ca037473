"""A Radiance scene by the Mitsuba renderer, beside Radiance's own rtrace: mean luminance of six patches of one view.

The six patches are those windows of the picture that are most even, a margin of three pixels included, and see a
surface: nothing bright may reach them through the reconstruction filter. Radiance's reference sends rays
through the same pixels, without its ambient cache, so that its error is noise alone, which is printed.

    python benchmarks/radiance_scene.py office.rad --sky sky.rad --camera office.vf
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import steadylight as sl
from steadylight.images import read_exr
from steadylight.renderers.radiance.view import View
from steadylight.scenes.radiance.programs import command, environment

WEIGHTS = np.array([0.265, 0.670, 0.065])
"""Radiance's luminance of RGB; times 179 it is cd/m²."""

PATCHES, SIDE, MARGIN = 6, 10, 3


def main() -> None:
    """Print the patches and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--sky", type=Path)
    parser.add_argument("--camera", type=Path)
    parser.add_argument("--frame", type=int, default=1)
    parser.add_argument("--size", default="192x108")
    parser.add_argument("--quality", default="normal")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--divisions", type=int, default=512, help="of rtrace (-ad)")
    parser.add_argument(
        "--bounces", default="auto", help="ours; the sky costs rtrace one more (auto: -ab 30)"
    )
    parser.add_argument("--mode", default="two-pass", help="ours")
    parser.add_argument("--output", type=Path, help="run directory to keep")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        output = given.output or Path(place) / "run"
        request = sl.plan(
            given.scene, sky=given.sky, camera=given.camera, frames=[given.frame], size=given.size
        )
        path, width, height = request.scene.camera, request.settings.width, request.settings.height
        sl.render(
            given.scene,
            sky=given.sky,
            camera=path,
            frames=[given.frame],
            fps=request.settings.fps,
            size=given.size,
            quality=given.quality,
            spp=given.spp,
            bounces=given.bounces,
            mode=given.mode,
            output=output,
        )
        image = read_exr(next((output / "frames").glob("*.exr"))).astype(np.float64)
        view = View(path.frame_poses([given.frame], request.settings.fps)[0], width, height)
        octree = Path(place) / "scene.oct"
        folder = given.scene.absolute().parent
        bounces = 30 if given.bounces == "auto" else int(given.bounces) + 1
        files = [str(file.absolute()) for file in (given.sky, given.scene) if file is not None]
        octree.write_bytes(ran(folder, command("oconv", "-f", "-w", *files)))
        report(image @ WEIGHTS, view, octree, folder, ("-ab", bounces, "-ad", given.divisions))


def ran(folder: Path, call: list[str], data: bytes = b"") -> bytes:
    """Standard output of a program."""
    done = subprocess.run(
        call, cwd=folder, env=environment(folder), input=data, capture_output=True, check=True
    )
    return done.stdout


def traced(folder: Path, octree: Path, rays: np.ndarray, *options: object) -> np.ndarray:
    """What rtrace gives for rays, (N, values)."""
    call = command("rtrace", "-h", "-w", "-fff", *options, octree)
    return np.frombuffer(ran(folder, call, rays.astype("<f4").tobytes()), "<f4").reshape(len(rays), -1)


def report(
    luminance: np.ndarray, view: View, octree: Path, folder: Path, quality: tuple[object, ...]
) -> None:
    """Choose the patches, and print how they compare."""
    height, width = luminance.shape
    y, x = np.mgrid[0:height, 0:width]
    points = np.stack([(x + 0.5) / width, (y + 0.5) / height], axis=2)
    distance = traced(folder, octree, view.rays(points.reshape(-1, 2)), "-ab", 0, "-oL").reshape(
        height, width
    )
    windows = []
    for top in range(MARGIN, height - SIDE - MARGIN, SIDE // 2):
        for left in range(MARGIN, width - SIDE - MARGIN, SIDE // 2):
            around = (slice(top - MARGIN, top + SIDE + MARGIN), slice(left - MARGIN, left + SIDE + MARGIN))
            seen, part = luminance[around], (slice(top, top + SIDE), slice(left, left + SIDE))
            if distance[around].max() < 1e6 and seen.min() > 0:
                windows.append((seen.std() / seen.mean(), part))
    windows.sort(key=lambda pair: pair[0])
    print("| patch | Radiance, cd/m² | noise, % | ours, cd/m² | ratio |")
    print("| --- | --- | --- | --- | --- |")
    ratios = []
    for _, part in spread(windows):
        rays = view.rays(points[part].reshape(-1, 2))
        words = ("-aa", 0, "-as", 0, "-dt", 0, "-ds", 0.05, "-st", 0, "-lr", 0, "-lw", 1e-5, *quality)
        seen = traced(folder, octree, rays, *words) @ WEIGHTS
        reference, ours = 179 * seen.mean(), 179 * luminance[part].mean()
        noise = 100 * seen.std() / seen.mean() / np.sqrt(len(seen))
        ratios.append(ours / reference)
        place = f"{part[1].start + SIDE // 2},{part[0].start + SIDE // 2}"
        print(f"| {place} | {reference:.4g} | {noise:.2f} | {ours:.4g} | {ratios[-1]:.4f} |", flush=True)
    print(
        f"mean ratio {np.mean(ratios):.4f}, largest difference {100 * np.abs(np.array(ratios) - 1).max():.2f} %"
    )


def spread(windows: list[tuple[float, tuple[slice, slice]]]) -> list[tuple[float, tuple[slice, slice]]]:
    """The most even windows that do not touch each other."""
    chosen: list[tuple[float, tuple[slice, slice]]] = []
    for window in windows:
        apart = [
            max(abs(window[1][0].start - other[0].start), abs(window[1][1].start - other[1].start))
            for _, other in chosen
        ]
        if min(apart, default=99) >= 2 * SIDE:
            chosen.append(window)
        if len(chosen) == PATCHES:
            break
    return chosen


if __name__ == "__main__":
    main()

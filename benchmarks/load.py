"""Time and memory to load a large scene file, and to build it in a worker.

    python benchmarks/load.py [FILE] [--triangles 1000000] [--textures 200] [--pixels 1024] [--meshes 200] [--json FILE]

Without a FILE, a GLB file is made by trimesh: bumpy sheets with texture coordinates, each with a base colour texture
of its own (photograph-like noise, PNG). Each step runs in a fresh process, whose peak resident memory is its own:

    load     the file becomes a description
    hash     ... and is hashed
    archive  ... and is written for the workers (scene.zip)
    build    a worker reads the archive and builds Mitsuba's scene
    render   ... and traces a first picture of 64x36 pixels: kernels are compiled, textures looked up

A worker builds the scene once, whatever number of tasks it performs: `animation/tasks.py` keeps it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from provenance import provenance

from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant


def make(path: Path, given: argparse.Namespace) -> None:
    """Write a GLB file of bumpy sheets."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    random = np.random.default_rng(0)
    across = max(2, round(np.sqrt(given.triangles / given.meshes / 2)) + 1)
    x, y = np.meshgrid(np.linspace(0, 1, across), np.linspace(0, 1, across))
    index = np.arange(across * across).reshape(across, across)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    scene = trimesh.Scene()
    images = []
    for _ in range(given.textures):
        coarse = random.random((given.pixels // 16, given.pixels // 16, 3))
        smooth = Image.fromarray((255 * coarse).astype(np.uint8)).resize((given.pixels, given.pixels))
        noise = random.integers(-6, 7, (given.pixels, given.pixels, 1))
        images.append(Image.fromarray(np.clip(np.asarray(smooth) + noise, 0, 255).astype(np.uint8)))
    side = int(np.ceil(np.sqrt(given.meshes)))
    for number in range(given.meshes):
        z = 0.05 * np.sin(12 * x + number) * np.cos(9 * y)
        vertices = np.stack([x + 1.1 * (number % side), z, y + 1.1 * (number // side)], axis=-1).reshape(
            -1, 3
        )
        material = PBRMaterial(
            baseColorTexture=images[number % given.textures], metallicFactor=0.0, roughnessFactor=0.6
        )
        visual = TextureVisuals(uv=np.stack([x, y], axis=-1).reshape(-1, 2), material=material)
        scene.add_geometry(trimesh.Trimesh(vertices, faces, visual=visual, process=False))
    path.write_bytes(scene.export(file_type="glb"))


class Watch:
    """Seconds and memory of steps."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def note(self, step: str, **more: float) -> None:
        """A step is over."""
        wall, cpu = time.perf_counter(), time.process_time()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        self.rows.append(
            {"step": step, "seconds": wall - self._wall, "cpu": cpu - self._cpu, "memory": peak, **more}
        )
        self._wall, self._cpu = time.perf_counter(), time.process_time()


def load(path: Path, archive: Path) -> list[dict[str, Any]]:
    """The steps of the command."""
    from steadylight.scenes import load_scene
    from steadylight.scenes.archive import write_archive

    watch = Watch()
    scene = load_scene(path)
    watch.note("load")
    _ = scene.hash
    watch.note("hash")
    write_archive(archive, scene, with_files=True)
    watch.note("archive", size=archive.stat().st_size / 1e9)
    return watch.rows


def build(archive: Path) -> list[dict[str, Any]]:
    """The steps of a worker."""
    import dataclasses

    use_variant(resolve_variant("auto"))
    import mitsuba as mi

    from steadylight.renderers.mitsuba.scene import build_scene, build_sensor
    from steadylight.scenes.archive import read_archive

    watch = Watch()
    scene = read_archive(archive)
    lit = dataclasses.replace(scene, content={**scene.content, "benchmark sky": {"type": "constant"}})
    built = build_scene(lit, {"type": "direct"})
    watch.note("build")
    sensor = build_sensor(lit, lit.camera.pose(0.0), 64, 36)
    watch.note("render", mean=float(np.array(mi.render(built, sensor=sensor, spp=16)).mean()))
    return watch.rows


def main() -> None:
    """Print a line for each step."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--textures", type=int, default=200)
    parser.add_argument("--meshes", type=int, default=200)
    parser.add_argument("--pixels", type=int, default=1024)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = given.file or Path(folder) / "large.glb"
        archive = Path(folder) / "scene.zip"
        steps: list[tuple[Any, tuple[Any, ...]]] = [(load, (path, archive)), (build, (archive,))]
        if given.file is None:
            steps.insert(0, (make, (path, given)))  # its memory would count as that of its children
        for function, arguments in steps:
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                rows += pool.submit(function, *arguments).result() or []
        print(f"{path.name}: {path.stat().st_size / 1e9:.2f} GB")
    print("| Step | Seconds | Processor seconds | Peak memory, GB |")
    print("| --- | --- | --- | --- |")
    for row in rows:
        more = f" ({row['size']:.2f} GB on disk)" if "size" in row else ""
        print(f"| {row['step']}{more} | {row['seconds']:.1f} | {row['cpu']:.1f} | {row['memory']:.2f} |")
    if given.json:
        given.json.write_text(json.dumps({"rows": rows, "provenance": provenance()}, indent=2))


if __name__ == "__main__":
    main()

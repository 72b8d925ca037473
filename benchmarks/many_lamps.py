"""One room lit by few lamps and by many that give as much light: error and time of a frame.

    python benchmarks/many_lamps.py [NAME ...] [--output runs/lamps] [--frames 8] [--size 384x216] [--paths 1024]

Each room, 8 m x 6 m x 3 m with twelve boxes, is rendered as a short film with 16 samples and `--denoise`, its first
frame also by path tracing, twice with other seeds. Columns: errors of the first frame without the noise of the
references (see accuracy.py), records, and CPU seconds of a frame of the second pass (see versions.py). Runs that are
there already, finished or not, are gone on with. Below each pair: many lamps over few.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import trimesh
from accuracy import measure
from provenance import provenance
from quality_sweep import costs
from versions import frame_cpu, tasks_done

from steadylight.images import read_exr, write_png

WIDTH, DEPTH, HEIGHT = 8.0, 6.0, 3.0
POWER = 60.0
"""W/sr of all lamps together; textured panels are dimmer, of one brightness."""

PAIRS = {
    "points": ("points-10", "points-1000"),
    "panels": ("mesh-10", "mesh-1000"),
    "textured": ("textured-10", "textured-100"),
}
CAMERA = """fov = 70
up = [0, 0, 1]
[[keyframes]]
time = 0
origin = [0.4, 0.4, 1.6]
target = [5, 4, -0.2]
[[keyframes]]
time = 1
origin = [0.6, 0.5, 1.6]
target = [5, 4, -0.2]
"""
"""Sees no lamp: how edges of small bright things are sampled is not to be told here."""


def places(count: int) -> np.ndarray:
    """(count, 3) places of lamps, even below the ceiling, metres."""
    columns = round(np.sqrt(count * WIDTH / DEPTH))
    rows = -(-count // columns)
    each = [
        ((x + 0.5) / columns * WIDTH, (y + 0.5) / rows * DEPTH, HEIGHT - 0.4)
        for y, x in product(range(rows), range(columns))
    ]
    return np.array(each[:count])


def room(name: str, folder: Path) -> Path:
    """Write the room with these lamps; returns its file."""
    kind, number = name.split("-")
    count = int(number)
    lit = {"points": points, "mesh": mesh, "textured": textured}[kind](places(count), folder)
    rng = np.random.default_rng(1)
    boxes = "".join(
        f"""
  <shape type="cube"><ref id="wall"/><transform name="to_world">
    <scale x="0.3" y="0.3" z="{h:.3f}"/><rotate z="1" angle="{turn:.1f}"/>
    <translate x="{1.6 + 1.7 * (k % 4):.3f}" y="{1.4 + 1.7 * (k // 4):.3f}" z="{h:.3f}"/></transform></shape>"""
        for k, (h, turn) in enumerate(zip(rng.uniform(0.2, 0.8, 12), rng.uniform(0, 90, 12), strict=True))
    )
    text = f"""<scene version="3.0.0">
  <bsdf type="diffuse" id="wall"><rgb name="reflectance" value="0.6, 0.55, 0.5"/></bsdf>
  <shape type="cube"><boolean name="flip_normals" value="true"/><transform name="to_world">
    <scale x="{WIDTH / 2}" y="{DEPTH / 2}" z="{HEIGHT / 2}"/>
    <translate x="{WIDTH / 2}" y="{DEPTH / 2}" z="{HEIGHT / 2}"/></transform><ref id="wall"/></shape>{boxes}{lit}
</scene>
"""
    path = folder / f"{name}.xml"
    path.write_text(text)
    return path


def points(at: np.ndarray, _folder: Path) -> str:
    """Point lights."""
    value = POWER / len(at)
    return "".join(
        f"""
  <emitter type="point"><point name="position" x="{x}" y="{y}" z="{z}"/>
    <rgb name="intensity" value="{value}"/></emitter>"""
        for x, y, z in at
    )


def mesh(at: np.ndarray, folder: Path) -> str:
    """Square panels in one mesh, which is one emitter."""
    half = np.sqrt(1.0 / len(at)) / 2
    corners = np.array([(-1, -1, 0), (-1, 1, 0), (1, 1, 0), (1, -1, 0)]) * half
    faces = 4 * np.arange(len(at))[:, None, None] + [(0, 1, 2), (0, 2, 3)]
    path = folder / f"panels-{len(at)}.ply"
    squares = trimesh.Trimesh((at[:, None] + corners).reshape(-1, 3), faces.reshape(-1, 3), process=False)
    squares.export(path)
    return f"""
  <shape type="ply"><string name="filename" value="{path.name}"/>
    <emitter type="area"><rgb name="radiance" value="{POWER}"/></emitter></shape>"""


def textured(at: np.ndarray, folder: Path) -> str:
    """Square panels with a picture each, bright in the middle."""
    y, x = np.mgrid[0:32, 0:32] / 31 - 0.5
    picture = np.where(np.hypot(x, y) < 0.2, 1.0, 0.1)
    write_png(folder / "panel.png", np.repeat((255 * picture)[..., None], 3, axis=2).astype(np.uint8))
    scale = np.sqrt(1.0 / len(at)) / 2
    return "".join(
        f"""
  <shape type="rectangle"><transform name="to_world"><scale value="{scale}"/><rotate x="1" angle="180"/>
    <translate x="{x}" y="{y}" z="{z}"/></transform><emitter type="area">
    <texture type="bitmap" name="radiance"><string name="filename" value="panel.png"/><boolean name="raw" value="true"/>
    </texture></emitter></shape>"""
        for x, y, z in at
    )


def render(folder: Path, scene: Path, name: str, **settings: object) -> Path:
    """The run directory of a run with these settings."""
    run = folder / name
    given = {"camera": folder / "camera.toml", "output": run, "bounces": 4, **settings}
    options = [f"--{key}" if value is True else f"--{key}={value}" for key, value in given.items()]
    command = [sys.executable, "-m", "steadylight", "render", str(scene), *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return run


def measured(folder: Path, name: str, given: argparse.Namespace) -> dict[str, float]:
    """Error, records and time of a room."""
    scene = room(name, folder)
    size = {"size": given.size}
    run = render(folder, scene, f"{name}-film", frames=given.frames, spp=16, denoise=True, **size)
    path = {"mode": "path", "frames": 1, "spp": given.paths, **size}
    a, b = (render(folder, scene, f"{name}-path-{seed}", seed=seed, **path) for seed in (11, 12))
    frame = "frames/frame_00001.exr"
    error = measure(read_exr(run / frame), read_exr(a / frame), read_exr(b / frame))
    return {
        "rel_rmse": error["rel_rmse"],
        "rel_bias": error["rel_bias"],
        "records": costs(run)["records"],
        "frame_s": frame_cpu([each for each in tasks_done(run) if each["stage"] == "shade"]),
    }


def main() -> None:
    """Print a table, and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PAIRS)}; all if none")
    parser.add_argument("--output", type=Path, default=Path("runs/lamps"))
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", default="384x216")
    parser.add_argument("--paths", type=int, default=1024, help="samples a pixel of the references")
    given = parser.parse_args()
    folder = given.output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.toml").write_text(CAMERA)
    found = {}
    columns = ("rel_rmse", "rel_bias", "records", "frame_s")
    print(f"{'room':14}" + "".join(f"{column:>12}" for column in columns), flush=True)
    for pair in given.names or PAIRS:
        few, many = (measured(folder, name, given) for name in PAIRS[pair])
        for name, row in zip(PAIRS[pair], (few, many), strict=True):
            found[name] = row
            print(f"{name:14}" + "".join(f"{row[column]:12.4g}" for column in columns))
        told = few["rel_rmse"] > 0 and many["rel_rmse"] > 0
        error = f"{many['rel_rmse'] / few['rel_rmse']:.2f} times" if told else "lost in the references' noise"
        print(f"{'':14}error {error}, time {many['frame_s'] / few['frame_s']:.2f} times", flush=True)
    print(json.dumps({**provenance(), "rooms": found}))


if __name__ == "__main__":
    main()

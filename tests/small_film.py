"""A small real film for end-to-end tests: its files, the command that renders it, and what it leaves."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time

SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <float name="fov" value="60"/>
    <transform name="to_world"><lookat origin="0, -0.9, 0.2" target="0, 1, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film>
  </sensor>
  <bsdf type="diffuse" id="clay"><rgb name="reflectance" value="0.5, 0.4, 0.3"/></bsdf>
  <shape type="cube"><boolean name="flip_normals" value="true"/><ref id="clay"/></shape>
  <shape type="sphere">
    <float name="radius" value="0.3"/><point name="center" x="0.2" y="0.5" z="-0.4"/><ref id="clay"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="0.3"/><rotate x="1" angle="180"/><translate z="0.99"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="8"/></emitter>
  </shape>
</scene>
"""

PANES = """
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="40"/><translate y="0.2" z="0.3"/></transform>
    <bsdf type="thindielectric"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><scale value="0.4"/><translate z="0.7"/></transform>
    <bsdf type="mask"><float name="opacity" value="0.4"/><ref id="clay"/></bsdf>
  </shape>
</scene>
"""
GLAZED = SCENE.replace("</scene>\n", PANES)
"""The same with a pane across the room, and a sheet half open below the lamp."""

CAMERA = """
fps = 3
[[keyframes]]
time = 0
origin = [0, -0.9, 0.2]
target = [0, 1, 0]
[[keyframes]]
time = 1
origin = [0.4, -0.7, 0.1]
target = [-0.2, 1, -0.1]
"""

OPTIONS = ("--spp", "2", "--quality", "draft")
FRAMES = 4
TASKS = 11  # prepare, look, gather, merge, audit, fill, smooth, 4 shade
PARTS = ("--cache-parts", "4")


def write_film(folder):
    """Write `room.xml`, `glazed.xml` and `walk.toml` into a folder."""
    (folder / "room.xml").write_text(SCENE)
    (folder / "glazed.xml").write_text(GLAZED)
    (folder / "walk.toml").write_text(CAMERA)


def command(output, *more, scene="room.xml"):
    """The command line that renders the film, as a list."""
    film = ("--camera", "walk.toml") if scene.endswith(".xml") else ("--frames", "4", "--size", "32x24")
    program = (sys.executable, "-m", "steadylight", "render", scene)
    return [*program, *film, *OPTIONS, "--output", str(output), *more]


def render(folder, output, *more, scene="room.xml"):
    """Render the film in a process of its own; returns what it said."""
    given = command(output, *more, scene=scene)
    done = subprocess.run(given, cwd=folder, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def digests(run):
    """SHA-256 of every file of a run whose bytes must be the same everywhere, by name."""
    files = sorted([*run.glob("frames/*"), *run.glob("cache/*")])
    return {path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def journal(run):
    """The journal's entries; lines cut short by a kill are left out."""
    path = run / "log" / "tasks.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    entries = []
    for line in lines:
        try:
            entries.append(json.loads(line))
        except ValueError:
            continue
    return entries


def wait_until(condition, process, seconds=300.0):
    """Poll often, since some stages last for milliseconds only."""
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "the command ended before it could be stopped"
        assert time.monotonic() < end, "the command did not get that far"
        time.sleep(0.001)

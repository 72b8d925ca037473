"""Animations by Radiance's rpict alone: processes on all cores that share an ambient file, or have one for each frame.

Frames are rendered larger than asked for and filtered down by the Gaussian of Mitsuba's film, instead of by pfilt: so
all rivals show the same picture. The seconds are rpict's alone.
"""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.renderers.radiance.export import RadianceScene
from steadylight.renderers.radiance.picture import filtered
from steadylight.renderers.radiance.view import View
from steadylight.scenes.radiance.programs import command, environment, output_of

OVERTURE = 64
"""Columns of the picture that is rendered first, so that all processes begin with some records."""


Running = tuple[subprocess.Popen[str], Path]
"""A process of rpict and the folder of its pictures."""


@dataclass(frozen=True)
class Quality:
    """Options of rpict that trade time for error.

    Attributes:
        name: for the table.
        oversampling: rendered columns (and rows) for each pixel.
        sample: `-ps`: rendered pixels between two rays, at first.
        threshold: `-pt`: contrast that asks for more rays between them.
        accuracy: `-aa`.
        divisions: `-ad`.
        supersamples: `-as`.
        spacing: metres between records at least; `-ar` is derived from it.
        sources: `-ds`: size over distance beyond which a part of an area source is divided.
    """

    name: str
    oversampling: int
    sample: int
    threshold: float
    accuracy: float
    divisions: int
    supersamples: int
    spacing: float
    sources: float


# Spaced as the low, medium and high quality of Radiance's own `rad`.
QUALITIES = (
    Quality("low", 2, 2, 0.05, 0.30, 128, 32, 0.30, 0.5),
    Quality("medium", 3, 2, 0.03, 0.20, 400, 100, 0.15, 0.35),
    Quality("high", 4, 2, 0.02, 0.15, 1024, 256, 0.08, 0.25),
)


@dataclass(frozen=True)
class Film:
    """A film that rpict rendered.

    Attributes:
        images: (height, width, 3) scene-linear RGB of each frame.
        seconds: wall time of all processes, overture and loading of the scene included.
    """

    images: list[NDArray[np.float32]]
    seconds: float


class Rpict:
    """Renders films of one scene."""

    def __init__(self, scene: RadianceScene, size: tuple[int, int], bounces: int, processes: int) -> None:
        """Make it ready.

        Args:
            scene: exported.
            size: width and height of a frame, pixels.
            bounces: indirect diffuse bounces of the light of lamps and sun, `-ab`; light of the sky has one less.
            processes: at a time.
        """
        self.scene, self.size, self.bounces, self.processes = scene, size, bounces, processes

    def shared(self, poses: Sequence[Pose], quality: Quality, folder: Path) -> Film:
        """All frames with one ambient file in `folder`, which grows while they are rendered, or is there already."""
        folder.mkdir(parents=True, exist_ok=True)
        ambient = ("-af", str((folder / "ambient.amb").resolve()))
        start = time.perf_counter()
        if not (folder / "ambient.amb").exists():
            small = OVERTURE, max(1, round(OVERTURE * self.size[1] / self.size[0]))
            options = [*self._options(quality), *ambient]
            self._wait([self._start(options, small, [self._view(poses[0])], folder / "overture")])
        options = [*self._options(quality), *ambient]
        runs = []
        for number in range(min(self.processes, len(poses))):
            views = [self._view(pose) for pose in poses[number :: self.processes]]
            views = [self._view_of_nothing()] * number + views
            runs.append(self._start(options, self._large(quality), views, folder / f"process{number}"))
        self._wait(runs)
        seconds = time.perf_counter() - start
        images = []
        for number in range(len(poses)):
            turn, process = divmod(number, self.processes)
            images.append(self._read(folder / f"process{process}" / f"{process + turn + 1}.hdr", quality))
        return Film(images, seconds)

    def apart(self, poses: Sequence[Pose], quality: Quality, folder: Path) -> Film:
        """Each frame by a process of its own, which keeps its ambient values to itself."""
        folder.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        running: list[Running] = []
        for number, pose in enumerate(poses):
            if len(running) == self.processes:
                self._wait(running[:1])
                running = running[1:]
            views = [self._view_of_nothing()] * number + [self._view(pose)]
            running.append(
                self._start(self._options(quality), self._large(quality), views, folder / f"frame{number}")
            )
        self._wait(running)
        seconds = time.perf_counter() - start
        images = [
            self._read(folder / f"frame{number}" / f"{number + 1}.hdr", quality)
            for number in range(len(poses))
        ]
        return Film(images, seconds)

    def _options(self, quality: Quality) -> list[str]:
        """Everything but the view and the ambient file."""
        values = {
            "-ab": self.bounces,
            "-aa": quality.accuracy,
            "-ad": quality.divisions,
            "-as": quality.supersamples,
            "-ar": math.ceil(self.scene.cube / quality.spacing),
            "-av": "0 0 0",
            "-ds": quality.sources,
            "-dj": 1,  # less leaves out the edges of area sources: with 0.9 walls beside lamp wells were 2 % too bright
            "-dt": 0.03,
            "-dc": 0.75,
            "-ps": quality.sample,
            "-pt": quality.threshold,
            "-pj": 1,
            "-st": 0.01,  # the gloss of plastic is 0.04, and would not be sampled at more
            "-lw": 1e-4,
            "-lr": 12,
            "-pa": 0,
        }
        return [word for option, value in values.items() for word in (option, *str(value).split())]

    def _large(self, quality: Quality) -> tuple[int, int]:
        return self.size[0] * quality.oversampling, self.size[1] * quality.oversampling

    def _view(self, pose: Pose) -> str:
        """A perspective view as rpict reads it."""
        return " ".join(["rvu", *View(pose, *self.size).words, "-vo 0 -va 0 -vs 0 -vl 0"])

    def _view_of_nothing(self) -> str:
        """From beyond the scene and away from it, almost without height: takes no time.

        All processes begin with the same random numbers, and rpict has no seed: some of these before its first frame
        give a process others.
        """
        far = 10 * self.scene.cube
        narrow = 60.0 / self.size[0]
        return f"rvu -vtv -vp {far} {far} {far} -vd 1 1 1 -vu 0 0 1 -vh 60 -vv {narrow:.9g} -vo 0 -va 0 -vs 0 -vl 0"

    def _start(
        self, options: Sequence[str], resolution: tuple[int, int], views: Sequence[str], folder: Path
    ) -> Running:
        """Begin to render views into numbered pictures of a folder."""
        folder.mkdir(exist_ok=True)
        for old in folder.glob("*.hdr"):
            old.unlink()
        (folder / "views").write_text("\n".join(views) + "\n")
        x, y = resolution
        call = command("rpict", "-S", 1, "-o", f"{folder.resolve()}/%d.hdr", "-x", x, "-y", y, *options)
        with (folder / "views").open() as asked, (folder / "messages").open("w") as said:
            return self._run([*call, self.scene.octree.name], asked, said), folder

    def _run(self, call: Sequence[str], asked: IO[str], said: IO[str]) -> subprocess.Popen[str]:
        where = self.scene.octree.parent
        return subprocess.Popen(call, stdin=asked, stderr=said, cwd=where, env=environment(where), text=True)

    def _wait(self, running: Sequence[Running]) -> None:
        """Until all are done."""
        for process, folder in running:
            if process.wait():
                raise SystemExit(f"rpict failed: {(folder / 'messages').read_text().strip()}")

    def _read(self, path: Path, quality: Quality) -> NDArray[np.float32]:
        """A picture of rpict, filtered down."""
        x, y = self._large(quality)
        values = np.frombuffer(
            output_of(path.parent, "pvalue", "-h", "-H", "-df", path.resolve()), np.float32
        )
        return filtered(values.reshape(y, x, 3), quality.oversampling)

"""How right the secondary cache is: gathers that ask it over gathers that ask for the truth, by brightness.

    python benchmarks/secondary.py [SCENE] [--camera FILE] [--frame 1] [--caches 3] [--paths 1600]

Points that one frame sees gather twice by the same paths: once from the secondary cache as it is made, once with the
irradiance of each of its records measured by paths without a cache. So the ratio has no noise but that of the records.
A record lights many points, so a few caches, from other random numbers each, tell how far the noise of records goes.

Columns: secondary records; seconds of processor time to prepare; the ratio in each sixth of the points, the darkest
first; that of all. The last two lines are the mean and the standard deviation of the caches.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
from provenance import provenance
from radii import points_in_sight

import steadylight as sl
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.settings import RenderSettings

if TYPE_CHECKING:
    from steadylight.renderers.mitsuba.renderer import Renderer

SIXTHS = 6


class Comparison:
    """Points of one frame, and what arrives at them."""

    def __init__(self, renderer: Renderer, points: int, paths: int) -> None:
        """Choose points at random among those that the camera sees, as it is placed.

        Args:
            renderer: of the scene.
            points: how many.
            paths: of each gather; at least 400.
        """
        self._renderer, self._paths = renderer, paths
        self._seen = points_in_sight(renderer, points)

    def of_one_cache(self, number: int) -> np.ndarray:
        """Records, seconds, and the ratios of a secondary cache that is made with random numbers of its own."""
        from steadylight.renderers.mitsuba.records import secondary
        from steadylight.renderers.mitsuba.sampling import seed_of

        begin = time.process_time()
        with patch.object(secondary, "seed_of", lambda *numbers: seed_of(number, *numbers)):
            prepared = self._renderer.prepare()
        seconds = time.process_time() - begin
        made = prepared.secondary
        if made is None:
            raise SystemExit("there is no secondary cache: nothing lights these surfaces by way of others")
        self._renderer.use(prepared)
        mine = self._irradiance(self._seen.position, self._seen.normal, seed=1)
        truth = self._irradiance(made.records.position, made.records.normal, seed=2, ask=False)
        right = dataclasses.replace(made.records, irradiance=truth[:, None].astype(np.float32))
        self._renderer.use(prepared._replace(secondary=made._replace(records=right)))
        theirs = self._irradiance(self._seen.position, self._seen.normal, seed=1)
        mine, theirs = mine.mean(axis=1), theirs.mean(axis=1)
        rows = np.array_split(np.argsort(theirs), SIXTHS)
        ratios = [mine[some].sum() / theirs[some].sum() for some in (*rows, slice(None))]
        return np.array([len(made.records), seconds, *ratios])

    def _irradiance(
        self, position: np.ndarray, normal: np.ndarray, seed: int, ask: bool = True
    ) -> np.ndarray:
        """(P, 3) indirect irradiance at points, W/m²: with the secondary cache, or without."""
        from steadylight.renderers.mitsuba.records.gather import Places, gather_records
        from steadylight.renderers.mitsuba.records.radius import Bounds

        gather = self._renderer.filler.gather
        context = gather.context if ask else gather.context._replace(secondary=None)
        quality = dataclasses.replace(gather.quality, refinement_paths=(self._paths,))
        any_radius = Bounds(np.full(len(position), 1e-3, np.float32), np.ones(len(position), np.float32))
        records = gather_records(
            dataclasses.replace(gather, context=context, quality=quality),
            Places(position, normal, any_radius),
            seed,
        )
        return np.asarray(records.irradiance.sum(axis=1), np.float64)


def main() -> None:
    """Print a line for each cache, and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="gallery")
    parser.add_argument("--camera", type=Path)
    parser.add_argument("--frame", type=int, default=1)
    parser.add_argument("--size", default="384x216", metavar="WxH")
    parser.add_argument("--points", type=int, default=600)
    parser.add_argument("--paths", type=int, default=1600, help="of a gather; at least 400")
    parser.add_argument("--caches", type=int, default=3, help="at least two")
    given = parser.parse_args()
    use_variant(resolve_variant("auto"))
    from steadylight.renderers.mitsuba.renderer import Renderer

    request = sl.plan(given.scene, camera=given.camera)
    scene = request.scene
    pose = scene.camera.frame_poses([given.frame], request.settings.fps)[0]
    width, height = map(int, given.size.split("x"))
    settings = RenderSettings(frames=(given.frame,), width=width, height=height)
    renderer = Renderer(scene, {given.frame: pose}, settings)
    renderer.view.camera.look(pose)
    comparison = Comparison(renderer, given.points, given.paths)

    def line(name: str, row: np.ndarray) -> None:
        print(
            f"{name:>6}{row[0]:10.0f}{row[1]:8.1f}" + "".join(f"{each:8.4f}" for each in row[2:]), flush=True
        )

    sixths = "".join(f"{k + 1}/{SIXTHS}".rjust(8) for k in range(SIXTHS))
    print(f"{'cache':>6}{'records':>10}{'s':>8}{sixths}{'all':>8}")
    rows = []
    for number in range(given.caches):
        rows.append(comparison.of_one_cache(number))
        line(str(number + 1), rows[-1])
    mean, deviation = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1)
    line("mean", mean)
    line("std", deviation)
    print(
        json.dumps({**provenance(), "scene": given.scene, "mean": mean.tolist(), "std": deviation.tolist()})
    )


if __name__ == "__main__":
    main()

"""Error of interpolated irradiance against the number of records, by split-sphere radii and by the occlusion Hessian.

    python benchmarks/radii.py [SCENE ...] [--points 1500] [--full]

The radii alone are compared: no clamp at the nearest surface, no probes for what stands beside a point, no smoothing,
one pixel as the smallest radius. Points that one frame sees are gathered once for all; any of them may become a record.
For each accuracy the cache is filled as Ward has it, point after point, a record where none before answers, in
several random orders; then all points look up. What is looked up and what was gathered at the point are compared.

The records' noise is left out: the points are gathered twice, A and B. The radii and the choice of records are A's.
With e_A what records with A's values expect, less A's gather there, over the mean of both gathers and a tenth of its
mean, the mean of e_A e_B is the squared error without noise, since the noises of A and B are independent.

Columns: records; rel_rmse of both; their ratio; the same where the worst hundredth of the points is left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from provenance import provenance
from scipy.spatial import cKDTree

from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.scenes import load_scene
from steadylight.settings import Radii, RenderSettings

if TYPE_CHECKING:
    from steadylight.renderers.mitsuba.records.filling import Points
    from steadylight.renderers.mitsuba.renderer import Renderer

FRAMES = {"gallery": 1, "temple-walk": 30, "corridor": 1}
"""The frame whose points are gathered; of another scene the first."""

RULES: tuple[Radii, ...] = ("split-sphere", "occlusion-hessian")
ACCURACIES = 2.0 ** np.arange(-4, 1.1, 0.5)
ORDERS = 4
"""Random orders in which the cache is filled for each accuracy."""

WORST = 0.01
"""Part of the points that is left out of the second error: few points, in joints and behind ledges, are most of it."""

STEPS = 1.6
"""Ratio of the numbers of records at which errors are told."""

CROWDED = 3
"""Curves end where more than one in so many points has become a record: there are none left to be wrong at."""


class Gathered(NamedTuple):
    """Records at every point, twice, and their radius at an accuracy of 1, by rule."""

    records: tuple[Any, Any]  # cache.records.Records of P points, from different random numbers
    radius: dict[Radii, np.ndarray]  # (P,) metres
    smallest: np.ndarray  # (P,) metres
    largest: float  # metres


def points_in_sight(renderer: Renderer, count: int) -> Points:
    """Surface points that light paths of the camera look up, at random, where it stands."""
    from steadylight.cache.records import Records

    random = np.random.default_rng(0)
    film = random.random((count, 2), np.float32)
    seen, _ = renderer.view.missed_through(film, renderer.load(Records.empty()), 0)
    return seen.take(random.permutation(len(seen.position))[:count])


def gather(scene_name: str, points: int, paths: int) -> Gathered:
    """Gather at random points that a frame sees."""
    from steadylight.cache.records import Records
    from steadylight.renderers.mitsuba.quality import RecordQuality
    from steadylight.renderers.mitsuba.records.gather import Places, gather_records
    from steadylight.renderers.mitsuba.records.radius import Bounds
    from steadylight.renderers.mitsuba.renderer import Renderer
    from steadylight.renderers.mitsuba.view import diagonal

    scene = load_scene(scene_name)
    frame = FRAMES.get(scene_name, 1)
    pose = scene.camera.frame_poses([frame], scene.fps)[0]
    settings = RenderSettings(frames=(frame,), width=256, height=144, quality="draft")
    renderer = Renderer(scene, {frame: pose}, settings)
    filler = renderer.filler
    renderer.view.camera.look(pose)
    seen = points_in_sight(renderer, points)
    pixel = filler.bounds.at(seen.position).smallest / filler.gather.quality.minimum_spacing
    bounds = Bounds(pixel, np.full_like(pixel, np.inf))

    def made(radii: Radii, seed: int) -> Records:
        quality = RecordQuality(
            polar_strata=16,
            azimuth_strata=64,
            refinement_paths=(paths,),
            radii=radii,
            accuracy=1.0,
            clamped=False,
        )
        gather = dataclasses.replace(filler.gather, quality=quality)
        return gather_records(gather, Places(seen.position, seen.normal, bounds), seed)

    a, split, b = made(RULES[1], 1), made(RULES[0], 1), made(RULES[1], 2)
    radius = {"occlusion-hessian": a.radius, "split-sphere": split.radius}
    return Gathered((a, b), radius, pixel, 0.2 * diagonal(renderer.view.scene))


def curve(gathered: Gathered, rule: Radii) -> np.ndarray:
    """(accuracies, 3): records, rel_rmse, and that without the worst points."""
    return np.array([_mean_error(gathered, accuracy * gathered.radius[rule]) for accuracy in ACCURACIES])


def _mean_error(gathered: Gathered, wanted: np.ndarray) -> tuple[float, float, float]:
    largest = np.maximum(gathered.largest, gathered.smallest)
    radius = np.clip(wanted, gathered.smallest, largest).astype(np.float32)
    trust = np.minimum(1, wanted / radius).astype(np.float32)[:, None, None, None]  # as in `gather`
    everywhere = [
        dataclasses.replace(each, radius=radius, translation=each.translation * trust)
        for each in gathered.records
    ]
    a, b = (each.irradiance[:, 0].astype(np.float64) for each in gathered.records)
    scale = (a + b) / 2 + 0.1 * (a + b).mean() / 2
    counts, whole, most = [], [], []
    for order in range(ORDERS):
        rows = _filled(everywhere[0], np.random.default_rng(order))
        found_a, found_b = _looked_up([each.take(rows) for each in everywhere], a.shape, everywhere[0])
        squares = np.sort(((found_a - a) / scale * (found_b - b) / scale).mean(axis=1))
        counts.append(len(rows))
        whole.append(squares.mean())
        most.append(squares[: int(len(squares) * (1 - WORST))].mean())
    return float(np.mean(counts)), _root(whole), _root(most)


def _root(squares: list[float]) -> float:
    return float(np.sqrt(max(float(np.mean(squares)), 1e-12)))


def _filled(records: Any, random: np.random.Generator) -> np.ndarray:
    """Rows of the points that become records."""
    from steadylight.cache.lookup import ANSWERED, pair_weights

    near = cKDTree(records.position)
    weight = np.zeros(len(records))
    rows = []
    for row in random.permutation(len(records)):
        if weight[row] < ANSWERED:
            rows.append(row)
            others = np.array(near.query_ball_point(records.position[row], records.radius[row]))
            alone = np.full(1, row)
            weight[others] += pair_weights(records.position[others], records.normal[others], records, alone)
    return np.array(rows)


def _looked_up(caches: list[Any], shape: tuple[int, ...], points: Any) -> list[np.ndarray]:
    """(P, 3) what each cache gives at all points; the caches differ in their values only."""
    from steadylight.cache.lookup import extrapolated, pair_weights

    near = cKDTree(points.position).query_ball_point(caches[0].position, caches[0].radius)
    at = np.concatenate([np.asarray(rows, np.intp) for rows in near])
    record = np.repeat(np.arange(len(near)), [len(rows) for rows in near])
    position, normal = points.position[at], points.normal[at]
    share = pair_weights(position, normal, caches[0], record) / np.square(
        caches[0].radius[record], dtype=float
    )
    total = np.maximum(np.bincount(at, share, shape[0]), 1e-30)
    answers = []
    for cache in caches:
        E = np.maximum(extrapolated(position, normal, cache, record)[:, 0], 0)
        answers.append(np.stack([np.bincount(at, share * E[:, c], shape[0]) / total for c in range(3)], 1))
    return answers


def at_equal_records(curves: dict[Radii, np.ndarray], points: int) -> list[dict[str, float]]:
    """Errors of both rules at the same numbers of records, interpolated between the logarithms."""
    curves = {rule: each[np.argsort(each[:, 0])] for rule, each in curves.items()}
    least = max(each[0, 0] for each in curves.values())
    most = min(points / CROWDED, *(each[-1, 0] for each in curves.values()))
    rows = []
    for k in reversed(range(int(np.log(most / least) / np.log(STEPS)) + 1)):
        count = most / STEPS**k
        row = {"records": float(round(count))}
        for column, suffix in ((1, ""), (2, "_most")):
            for rule, each in curves.items():
                known, error = np.log(each[:, 0]), np.log(each[:, column])
                row[rule + suffix] = float(np.exp(np.interp(np.log(count), known, error)))
            row["ratio" + suffix] = row["split-sphere" + suffix] / row["occlusion-hessian" + suffix]
        rows.append(row)
    return rows


def main() -> None:
    """Print a table for each scene, and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", help="the gallery, and with --full two more, if none is named")
    parser.add_argument("--points", type=int, default=1500)
    parser.add_argument(
        "--paths", type=int, default=1024, help="refinement samples of a record; at least 400"
    )
    parser.add_argument("--full", action="store_true", help="three scenes, 6000 points, 2304 paths")
    options = parser.parse_args()
    scenes = options.scenes or (list(FRAMES) if options.full else ["gallery"])
    points, paths = (6000, 2304) if options.full else (options.points, options.paths)
    use_variant(resolve_variant("auto"))
    origin = provenance()  # before hours have passed, and commits with them
    found = {}
    names = [f"{name}{suffix}" for suffix in ("", "_most") for name in (*RULES, "ratio")]
    for name in scenes:
        start = time.perf_counter()
        gathered = gather(name, points, paths)
        curves = {rule: curve(gathered, rule) for rule in RULES}
        found[name] = at_equal_records(curves, points)
        print(f"{name}, {time.perf_counter() - start:.0f} s")
        print(f"{'records':>8}" + "".join(f"{each:>23}" for each in names))
        for row in found[name]:
            print(f"{row['records']:8.0f}" + "".join(f"{row[each]:23.4f}" for each in names), flush=True)
    print(json.dumps({**origin, "points": points, "paths": paths, "scenes": found}))


if __name__ == "__main__":
    main()

"""The readable twins of `hemisphere` and `gradients`: samples combined, irradiance and gradients."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np


def combine_samples(
    pilot: dict[str, np.ndarray],
    refinement: dict[str, np.ndarray],
    begin: np.ndarray,
    limits: tuple[float, float, float],
    azimuths: int,
) -> dict[str, np.ndarray]:
    """What arrives in each stratum of one record, from its pilot and refinement samples.

    Args:
        pilot: `L` (S, 3), `distance` (S,) and `tangent` (S,) of one path in each of S strata.
        refinement: the same of P further paths, those of each stratum together.
        begin: (S,) first of these in each stratum.
        limits: tan theta from which on a hit is no obstacle, tan theta up to which it is overhead, and the
            ratio to its stratum's nearest distance above which it is far.
        azimuths: strata around.

    Returns:
        `L` (S, 3), its `variance` (S,), `closeness` (S,), mean 1/distance, and `nearest` (S,), the least distance above
        the rim, `headroom` (S,), the least height of what is overhead; of the refinement samples, the part `beyond`
        an edge (S,), many times as far as the nearest, the means `near_light` and `far_light` (S, 3) and the greatest
        1/distance `near_closeness` and `far_closeness` (S,); of two halves, the first, third, ... and second, fourth,
        ... of these, half their `difference` (S, 3), and means `guide` (S, 2) with their `guide_variance`, and of
        either part `guide_near` and `guide_far`.
    """
    count = len(begin)
    rim, overhead, beyond = limits
    means = {
        "L": np.empty((count, 3)),
        "difference": np.zeros((count, 3)),
        "guide": np.empty((count, 2)),
        "guide_variance": np.empty((count, 2)),
        "guide_near": np.empty((count, 2)),
        "guide_far": np.empty((count, 2)),
        "near_light": np.empty((count, 3)),
        "far_light": np.zeros((count, 3)),
        "far_closeness": np.zeros(count),
        **{name: np.empty(count) for name in ("variance", "closeness", "nearest", "headroom")},
        **{name: np.empty(count) for name in ("beyond", "near_closeness")},
    }
    for s, (a, b) in enumerate(itertools.pairwise([*begin, len(refinement["L"])])):
        distance = np.array([pilot["distance"][s], *refinement["distance"][a:b]], np.float64)
        tangent = np.array([pilot["tangent"][s], *refinement["tangent"][a:b]], np.float64)
        above = tangent < overhead
        means["headroom"][s] = (distance / np.hypot(1, tangent))[above].min(initial=np.inf)
        seen = refinement["L"][a:b].astype(np.float64)
        grey = np.array([pilot["L"][s], *refinement["L"][a:b]], np.float64).mean(axis=1)
        close = 1 / distance[1:]
        far = close * beyond < close.max()
        means["beyond"][s] = far.mean()
        means["near_light"][s], means["near_closeness"][s] = seen[~far].mean(axis=0), close.max()
        if far.any():
            means["far_light"][s], means["far_closeness"][s] = seen[far].mean(axis=0), close[far].max()
        if len(seen) == 1:
            means["L"][s] = seen[0]
            share = 1.0
            nearby = [
                s - azimuths if s >= azimuths else s + azimuths,
                s - 1 if s % azimuths else s + azimuths - 1,
            ]
            own = pilot["L"].astype(np.float64).mean(axis=1)
            means["guide"][s] = means["guide_near"][s] = own[s]
            means["guide_far"][s] = 0
            means["guide_variance"][s] = np.square(own[s] - own[nearby]).sum() / 4
        else:
            halves = [seen[0::2], seen[1::2]]
            one, other = (half.mean(axis=0) for half in halves)
            means["L"][s] = (one + other) / 2
            means["difference"][s] = (one - other) / 2
            share = sum(1 / len(half) for half in halves) / 4
            for h, half in enumerate(halves):
                means["guide"][s, h] = half.mean()
                for name, part in (("guide_near", half[~far[h::2]]), ("guide_far", half[far[h::2]])):
                    whole = means["near_light" if name == "guide_near" else "far_light"][s]
                    means[name][s, h] = part.mean() if len(part) else whole.mean()
                known = np.array([grey[0], *half.mean(axis=1)])
                means["guide_variance"][s, h] = known.var(ddof=1) / len(half)
        means["variance"][s] = grey.var(ddof=1) * share
        means["closeness"][s] = (1 / distance).mean()
        means["nearest"][s] = distance[tangent < rim].min(initial=np.inf)
    return means


def reduce_strata(strata: dict[str, np.ndarray], frame: np.ndarray) -> dict[str, np.ndarray]:
    """Sums over M elevation x N azimuth strata of a cosine-weighted hemisphere.

    Ward & Heckbert, Irradiance Gradients, 1992. Stratum (j, k) spans sin² theta in [j/M, (j+1)/M] and phi in
    2 pi [k/N, (k+1)/N]. The sums of L and of L tan theta still lack the factor pi / (M N).

    Args:
        strata: `L` (M, N, 3) radiance and, (M, N) each, `variance` of its mean over the channels, `closeness`, mean
            1 / distance, 1/metres, and `nearest` obstacle, metres, maybe infinite; `beyond` to `far_closeness` as in
            `combine_samples`.
        frame: (3, 3) columns s, t, n of the local frame in the world.

    Returns:
        `E` (3,), `variance`, `closeness` and `horizon` (sums, the last over the lowest ring), `nearest` (the least),
        `translation` and `rotation` (3 channels, 3).
    """
    M, N, _ = strata["L"].shape
    L, closeness = (strata[name].astype(np.float64) for name in ("L", "closeness"))
    rotation = np.zeros((3, 3))
    translation = np.zeros((3, 3))
    for k in range(N):
        middle, border = 2 * np.pi * (k + 0.5) / N, 2 * np.pi * k / N
        u = np.array([np.cos(middle), np.sin(middle), 0])
        v = np.array([-np.sin(middle), np.cos(middle), 0])
        v_border = np.array([-np.sin(border), np.cos(border), 0])
        for j in range(M):
            # Turning the normal about v leans it towards u: a direction's cosine grows by sin theta, that is
            # by tan theta for every unit of cosine that the sampling density has taken up: its mean in the stratum.
            rotation += np.outer(L[j, k] * mean_tangent(j / M, (j + 1) / M), v)
            # Moving along u, or along the normal, widens or narrows the strata at their border with the ring above ...
            if j > 0:
                sin_border, cos_border = np.sqrt(j / M), np.sqrt(1 - j / M)
                sunk = cos_border * u - sin_border * np.array(
                    [0, 0, 1]
                )  # the border sinks as the record rises
                change = 2 * np.pi / N * sin_border * cos_border
                translation += np.outer(moved(strata, (j - 1, k), (j, k)), change * sunk)
            # ... and along v at their border with the neighbour in the ring (k = 0 follows k = N - 1).
            change = np.sqrt((j + 1) / M) - np.sqrt(j / M)
            translation += np.outer(moved(strata, (j, k - 1), (j, k)), change * v_border)
    return {
        "E": L.sum((0, 1)),
        "variance": strata["variance"].sum(dtype=np.float64),
        "closeness": closeness.sum(),
        "horizon": L[-1].mean(axis=1).sum(),
        "nearest": strata["nearest"].min(),
        "headroom": strata["headroom"].min(),
        "translation": translation @ frame.T,
        "rotation": rotation @ frame.T,
    }


def moved(strata: dict[str, np.ndarray], a: tuple[int, int], b: tuple[int, int]) -> np.ndarray:
    """What a step across the wall from stratum a to b gains for each unit of it: (3,) radiance over metres.

    Each stratum is a row of points in order of distance, its near part before its far one; those at the same place of
    the two rows are paired, and the nearer of two decides how fast what parts them moves.
    """
    ends = sorted({0.0, 1.0, *(1 - float(strata["beyond"][place]) for place in (a, b))})
    total = np.zeros(3)
    for low, high in itertools.pairwise(ends):
        parts = ["near" if (low + high) / 2 < 1 - strata["beyond"][place] else "far" for place in (a, b)]
        of_a, of_b = (
            strata[f"{part}_light"][place].astype(np.float64)
            for part, place in zip(parts, (a, b), strict=True)
        )
        nearer = max(strata[f"{part}_closeness"][place] for part, place in zip(parts, (a, b), strict=True))
        total += (high - low) * float(nearer) * (of_b - of_a)
    return total


def relative_error(L: np.ndarray, bright: np.ndarray, even: float, faint: float = 0.0) -> float:
    """`error_of_one_path` of one record, from the (M, N) luminance of its strata, plain and blurred; 0 in the dark."""
    M, N = L.shape
    variance = 0.0
    for j in range(M):
        for k in range(N):
            above = L[j - 1, k] if j else L[1, k]
            within = ((L[j, k] - above) ** 2 + (L[j, k] - L[j, k - 1]) ** 2) / 4
            total = bright.sum()
            share = even / L.size + (1 - even) * bright[j, k] / total if total else 1 / L.size
            variance += within / share
    return float(np.sqrt(variance) / (L.sum() + faint * L.size / np.pi)) if L.sum() else 0.0


def mean_tangent(low: float, high: float) -> float:
    """Mean of tan theta where sin² theta is even in [low, high]: integrated numerically in theta.

    d(sin² theta) = 2 sin theta cos theta d theta, so the integrand is 2 sin² theta: smooth up to the horizon.
    """
    theta, weight = np.polynomial.legendre.leggauss(12)
    begin, end = np.arcsin(np.sqrt([low, high]))
    theta = begin + (theta + 1) / 2 * (end - begin)
    return float((weight * 2 * np.sin(theta) ** 2).sum() * (end - begin) / 2 / (high - low))


def polygon_irradiance(corners: np.ndarray, position: np.ndarray, normal: np.ndarray) -> Any:
    """Irradiance from a polygon of unit radiance that lies above the horizon (Lambert 1760).

    E = 1/2 sum over edges of (angle that the edge subtends) * (normal of the plane of edge and point) . n.

    Args:
        corners: (C, 3) in order; the sign of the result depends on it and is dropped.
        position: (3,).
        normal: (3,).
    """
    to = (corners - position) / np.linalg.norm(corners - position, axis=1, keepdims=True)
    following = np.roll(to, -1, axis=0)
    across = np.cross(to, following)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.arctan2(length[:, 0], (to * following).sum(axis=1))
    return abs((angle * ((across / length) @ normal)).sum()) / 2

"""Columns of an Egyptian temple of the Roman period: lathed drums, bands and bell capitals with leaves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from steadylight.scenes.modelling import Floats, Mesh, box, join, lathe

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Capital = Literal["papyrus", "composite", "palm"]

_CAPITAL = 2.3  # height of a capital, in shaft radii
_BASE = 0.30  # height of a base, metres
_DRUM = 0.98  # height of a drum, metres
_ABACUS = 0.42  # height of the block between capital and beam, metres
_SLIM = 0.86  # radius of the shaft at its neck, in radii of its foot
_BURIED = 0.02  # overlap of neighbouring parts, metres


def column(height: float, radius: float, capital: Capital, segments: int) -> tuple[Mesh, Mesh]:
    """A column standing at the origin.

    Args:
        height: from the floor to the beam's underside, metres.
        radius: radius of the shaft's foot, metres.
        capital: kind of the capital.
        segments: points around the circumference.

    Returns:
        The smooth lathed part and the faceted abacus.
    """
    top = height - _ABACUS
    neck = top - _CAPITAL * radius
    slim = _SLIM * radius
    base = _rings(
        [(-_BURIED, 1.42), (0.06, 1.42), (0.2, 1.40), (0.26, 1.36), (_BASE, 1.28), (_BASE, 1.03)],
        radius,
        segments,
    )
    shaft = _shaft(radius, slim, neck, segments)
    bell_heights, bell = _bell(neck, top + _BURIED, slim, capital, segments)
    heights = np.concatenate([base[0], shaft[0], bell_heights])
    turned = lathe(np.concatenate([base[1], shaft[1], bell]), heights)
    half = 1.02 * radius
    block = box([-half, -half, top], [half, half, height + _BURIED])
    return turned, block


def colonnade(
    places: ArrayLike, kinds: list[Capital], height: float, radius: float, segments: int
) -> tuple[Mesh, Mesh]:
    """Columns of one size at several places, each with a different rotation.

    Args:
        places: (N, 3) feet of the columns, metres.
        kinds: capitals, repeated in this order.
        height: from foot to beam, metres.
        radius: radius of the shafts, metres.
        segments: points around the circumference.

    Returns:
        All lathed parts and all abaci.
    """
    models = {kind: column(height, radius, kind, segments) for kind in kinds}
    turned, blocks = [], []
    for k, place in enumerate(np.asarray(places, dtype=np.float64)):
        round_part, block = models[kinds[k % len(kinds)]]
        turned.append(round_part.turned(0.7 * k).moved(place))
        blocks.append(block.moved(place))
    return join(turned), join(blocks)


def shaft_radius(height: float, radius: float, z: ArrayLike) -> Floats:
    """Radius of a column's shaft at heights z above its foot, metres; see `column` for height and radius."""
    neck = height - _ABACUS - _CAPITAL * radius
    along = (np.asarray(z, dtype=np.float64) - _BASE) / (neck - _BASE)
    return np.asarray(radius * (1.0 - (1.0 - _SLIM) * along))


def _rings(profile: list[tuple[float, float]], radius: float, segments: int) -> tuple[Floats, Floats]:
    """Heights (R,) and radii (R, S) of a plain lathed profile of (height, radius in shaft radii)."""
    points = np.array(profile)
    return points[:, 0], np.repeat(points[:, 1:] * radius, segments, axis=1)


def _shaft(foot: float, head: float, neck: float, segments: int) -> tuple[Floats, Floats]:
    """Drums with open joints, and five bands below the capital; heights (R,) and radii (R, S)."""
    bands_from = neck - 0.62
    profile = [(_BASE + 0.03, 1.0)]
    for joint in np.arange(_BASE + _DRUM, bands_from - 0.3, _DRUM):
        profile += [(joint - 0.016, 1.0), (joint - 0.004, 0.98), (joint + 0.004, 0.98), (joint + 0.016, 1.0)]
    for k in range(5):
        z = bands_from + 0.124 * k
        profile += [(z, 1.0), (z + 0.02, 1.045), (z + 0.06, 1.065), (z + 0.10, 1.045)]
    heights, radii = _rings(profile, 1.0, segments)
    taper = foot + (head - foot) * ((heights - _BASE) / (neck - _BASE))
    return heights, radii * taper[:, None]


def _bell(low: float, high: float, radius: float, kind: Capital, segments: int) -> tuple[Floats, Floats]:
    """The capital: heights (R,) and radii (R, S), its top closed inwards to half the radius."""
    t = np.concatenate([np.linspace(0.02, 0.86, 24), [0.90, 0.94, 0.97, 0.99, 1.0, 1.0]])
    azimuth = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)[None, :]
    s = t[:, None]
    if kind == "papyrus":
        bell = 1.0 + 0.08 * s + 0.78 * s**2.6
        bell = bell + 0.09 * s**1.5 * (np.abs(np.cos(4 * azimuth)) - 0.6)
        bell = bell + _leaves(s, azimuth, (0.0, 0.42), 16, 0.05) + 0.014 * np.cos(32 * azimuth) * s
    elif kind == "composite":
        bell = 1.0 + 0.12 * s + 0.55 * s**1.8 + 0.08 * s * (np.abs(np.cos(2 * azimuth)) - 0.5)
        for tier in range(4):
            shift = np.pi / 8 * (tier % 2)
            bell = bell + _leaves(s, azimuth + shift, (0.02 + 0.22 * tier, 0.32), 8, 0.13)
    else:
        bell = 1.0 + 0.10 * s + 0.62 * s**2.2 + 0.07 * s**0.7 * (np.abs(np.cos(4.5 * azimuth)) - 0.6)
        bell = bell + 0.018 * np.cos(36 * azimuth) * np.sin(np.pi * np.minimum(s, 1.0))
        bell = bell + _leaves(s, azimuth, (0.55, 0.5), 9, 0.10)
    rim = np.array([0.99, 0.98, 0.95, 0.90, 0.82, 0.50])
    bell = bell * np.concatenate([np.ones(24), rim])[:, None]
    bell[-1] = 0.6  # the inner ring is hidden by the abacus
    return low + (high - low) * t, radius * bell


def _leaves(t: Floats, azimuth: Floats, span: tuple[float, float], count: int, relief: float) -> Floats:
    """A ring of pointed leaves whose tips stand out; added radius, in shaft radii."""
    foot, length = span
    along = np.clip((t - foot) / length, 0.0, 1.0)
    width = np.abs(np.cos(count * azimuth / 2))
    tip = np.clip((width - 0.9 * along**2) * 3.0, 0.0, 1.0)
    return np.asarray(relief * tip * np.sin(np.pi * np.clip(along, 0.0, 1.0)) ** 0.7)

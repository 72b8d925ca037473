"""Random numbers by address: the number that a path gets depends on where it is used, not on what was drawn before.

An address is pixel (or record), sample, branch, vertex and purpose. Pixel and seed form a key; branch, vertex and
purpose form a dimension. For each key and dimension there is one point set over the samples: the first two dimensions
of the Sobol' sequence, shuffled and scrambled by a hash of key and dimension (Owen scrambling by hashing: Laine &
Karras 2011; Burley 2020, "Practical Hash-based Owen Scrambling", JCGT 9(4)). The samples of a pixel are thus stratified
in every decision along their paths, for any number of samples, best for powers of two.

Kernels that follow the same path therefore agree without communication: the coverage audit, which traces no shadow
rays, meets exactly the surfaces that the frame will meet, and results do not depend on the wavefront size.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence: one over the plastic number, and its square (Roberts 2018, "The unreasonable effectiveness
of quasirandom sequences")."""

GOLDEN = 0.6180339887
"""Golden section, 1/phi: step between points made from a single one."""

VERTICES = 1 << 10
"""Vertices per branch with addresses of their own; more than any path has."""

_GOLDEN = 0x9E3779B9
"""2^32 / phi: step between the seeds of dimensions, before hashing."""


class Purpose(IntEnum):
    """What a random number is used for: the last part of its address."""

    PIXEL = 0
    """Position in the pixel."""
    APERTURE = 1
    """Position on the lens."""
    DIFFUSE_LOBE = 2
    """Direction sampled from the diffuse lobe alone, for its albedo."""
    LOBE = 3
    """Which lobe of the BSDF is sampled."""
    DIRECTION = 4
    """Direction within the lobe."""
    EMITTER = 5
    """Which emitter is sampled, and at which point."""
    MASK = 6
    """Direction for which the diffuse lobe of a mask is evaluated."""
    DIFFUSE_CHOICE = 7
    """Which BSDF of a mixture the diffuse lobe is sampled from."""
    ROULETTE = 8
    """Russian roulette."""
    RECORD = 9
    """Which of the secondary records around a point is used."""
    COUNT = 10


class Draw(NamedTuple):
    """Random numbers for sampling a BSDF."""

    lobe: mi.Float  # selects the lobe
    place: mi.Point2f  # selects the direction within it


@dataclass
class Samples:
    """The random numbers of one sample per lane.

    Attributes:
        key: hash of the seed and of the pixel or record; see `samples_of`.
        index: number of the sample in its set, from 0.
    """

    key: mi.UInt32
    index: mi.UInt32

    def at(self, branch: mi.UInt32, vertex: mi.UInt32) -> VertexSamples:
        """The random numbers for a vertex of a branch; both are counted from 0."""
        return VertexSamples(self, (branch * VERTICES + vertex) * int(Purpose.COUNT))


@dataclass
class VertexSamples:
    """The random numbers for one vertex of a path.

    Attributes:
        samples: of the path.
        dimension: the first dimension of the vertex.
    """

    samples: Samples
    dimension: mi.UInt32

    def sample_1d(self, purpose: Purpose) -> mi.Float:
        """A number in [0, 1)."""
        seed = self._seed(purpose)
        index = self._shuffled(seed)
        return _unit(dr.brev(_permuted(index, _hashed(seed + 1))))

    def sample_2d(self, purpose: Purpose) -> mi.Point2f:
        """A point in [0, 1)²; over the samples of a set, a scrambled (0, 2)-sequence in base 2."""
        seed = self._seed(purpose)
        index = self._shuffled(seed)
        x = dr.brev(_permuted(index, _hashed(seed + 1)))
        y = dr.brev(_permuted(_second_dimension(index), _hashed(seed + 2)))
        return mi.Point2f(_unit(x), _unit(y))

    def draw(self) -> Draw:
        """Random numbers for the direction in which the path leaves the vertex."""
        return Draw(self.sample_1d(Purpose.LOBE), self.sample_2d(Purpose.DIRECTION))

    def _seed(self, purpose: Purpose) -> mi.UInt32:
        return _hashed(self.samples.key + (self.dimension + int(purpose)) * _GOLDEN)

    def _shuffled(self, seed: mi.UInt32) -> mi.UInt32:
        return dr.brev(_permuted(dr.brev(self.samples.index), seed))


def roulette(
    numbers: VertexSamples, throughput: mi.Color3f, survival: mi.Float, active: mi.Bool
) -> tuple[mi.Color3f, mi.Bool]:
    """Russian roulette: end paths at random, and divide the throughput of the others by their survival probability.

    Args:
        numbers: of the current vertex.
        throughput: of the path.
        survival: probability that the path continues.
        active: lanes whose path has not ended yet.

    Returns:
        Throughput, and lanes whose path continues.
    """
    active = active & (numbers.sample_1d(Purpose.ROULETTE) < survival)
    return dr.select(active, throughput / survival, throughput), active


def stepped(point: mi.Point2f, number: mi.Float) -> mi.Point2f:
    """A point in [0, 1)² shifted by `number` steps of the R2 sequence."""
    return mi.Point2f(wrapped(point.x + number * R2[0]), wrapped(point.y + number * R2[1]))


def spread(point: mi.Point2f, number: mi.UInt32, share: mi.Float) -> mi.Point2f:
    """One of several points made from a single one in [0, 1)²: strata in x, golden-section steps in y.

    Made from each point of a set, they are together nearly as evenly distributed as a set of their total number.
    Shifted copies of a set have twice the variance where an edge crosses the square.

    Args:
        point: the point that all are made from.
        number: index of this one, from 0.
        share: reciprocal of their number.
    """
    number = mi.Float(number)
    x = dr.minimum((point.x + number) * share, dr.one_minus_epsilon(mi.Float))
    return mi.Point2f(x, wrapped(point.y + GOLDEN * number))


def wrapped(number: mi.Float) -> mi.Float:
    """Fractional part of a non-negative number, in [0, 1)."""
    return number - dr.floor(number)


def numbers_from(number: mi.Float, count: int) -> list[mi.Float]:
    """`count` numbers in [0, 1), at most 256: the given one, and others that are hashed from its upper 24 bits."""
    bits = mi.UInt32(number * 2.0**24) << 8
    return [mi.Float(number), *(_unit(_hashed(bits + k)) for k in range(1, count))]


def seed_of(*numbers: int) -> int:
    """A 32-bit seed hashed from integers (SplitMix64: Steele, Lea & Flood 2014)."""
    state = 0
    for number in numbers:
        state = (state + (number & 0xFFFFFFFFFFFFFFFF) + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state & 0xFFFFFFFF


def samples_of(seed: mi.UInt32, place: mi.UInt32, index: mi.UInt32) -> Samples:
    """Random numbers of samples.

    Args:
        seed: opaque; all numbers depend on it.
        place: number of the pixel or record that each lane works for.
        index: number of the sample there, from 0.
    """
    return Samples(_hashed(_hashed(mi.UInt32(place)) + seed), mi.UInt32(index))


def _hashed(x: mi.UInt32) -> mi.UInt32:
    """A bijective 32-bit hash of low bias (the constants are Chris Wellons', "Prospecting for hash functions")."""
    # Not in place: that would change the caller's array.
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


def _permuted(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen scrambling of reversed digits: a hash of the lower bits decides whether to flip a bit (Laine & Karras 2011).

    The constants are Nathan Vegdahl's, which scramble evenly.
    """
    x = (x ^ (x * 0x3D20ADEA)) + seed
    x = x * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def _second_dimension(index: mi.UInt32) -> mi.UInt32:
    """Reversed digits of the second Sobol' dimension: a product with Pascal's triangle modulo 2."""
    for shift, mask in (
        (16, 0xFFFF0000),
        (8, 0xFF00FF00),
        (4, 0xF0F0F0F0),
        (2, 0xCCCCCCCC),
        (1, 0xAAAAAAAA),
    ):
        index = index ^ ((index & mask) >> shift)
    return index


def _unit(x: mi.UInt32) -> mi.Float:
    """The upper 24 bits as a number in [0, 1)."""
    return mi.Float(x >> 8) * 2.0**-24

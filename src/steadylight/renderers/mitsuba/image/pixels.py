"""Camera rays through the pixels of a picture, in bands that bound the memory they take."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.camera import Pose
from steadylight.renderers.mitsuba.memory import SAMPLES_AT_ONCE, SPP_AT_ONCE
from steadylight.renderers.mitsuba.sampling import Purpose, Samples, samples_of
from steadylight.renderers.mitsuba.scene import set_pose


class Camera:
    """A sensor that is moved along the camera path, and the size of its pictures.

    Attributes:
        sensor: mi.Sensor.
        size: width and height, pixels.
    """

    def __init__(self, sensor: mi.Sensor, size: tuple[int, int]) -> None:
        self.sensor = sensor
        self.size = size
        self._time = dr.opaque(mi.Float, 0.0)

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return self.size[0]

    @property
    def pixels(self) -> int:
        """Pixels in a picture."""
        return self.size[0] * self.size[1]

    @property
    def random_aperture(self) -> bool:
        """Whether rays of a pixel begin at random places on a lens."""
        return bool(self.sensor.needs_aperture_sample())

    def look(self, pose: Pose) -> None:
        """Move the sensor to a pose, and to its time."""
        set_pose(self.sensor, pose)
        self._time = dr.opaque(mi.Float, pose.time)

    def rays(self, samples: Samples, position: mi.Point2f) -> mi.Ray3f:
        """Camera rays through film positions in [0, 1)²; weighted by nothing: the sensors we take have unit weight."""
        aperture = mi.Point2f(0.5)
        if self.random_aperture:
            aperture = samples.at(mi.UInt32(0), mi.UInt32(0)).sample_2d(Purpose.APERTURE)
        ray, _ = self.sensor.sample_ray(self._time, mi.Float(0.5), position, aperture)
        return ray

    def rays_through(self, samples: Samples, pixel: mi.UInt32) -> tuple[mi.Ray3f, mi.Point2f]:
        """Camera rays through random places of pixels.

        Args:
            samples: their random numbers.
            pixel: of each sample, row by row.

        Returns:
            The rays, and the offset in the pixel, [0, 1)².
        """
        width, height = self.size
        w = dr.opaque(mi.UInt32, width)
        row = pixel // w
        column = pixel - row * w
        offset = samples.at(mi.UInt32(0), mi.UInt32(0)).sample_2d(Purpose.PIXEL)
        corner = mi.Point2f(mi.Float(column), mi.Float(row))
        scale = mi.Vector2f(dr.opaque(mi.Float, 1 / width), dr.opaque(mi.Float, 1 / height))
        return self.rays(samples, (corner + offset) * scale), offset


class Sampling(NamedTuple):
    """How a picture is sampled.

    Attributes:
        spp: samples per pixel.
        seed: decides all random numbers.
    """

    spp: int
    seed: int


class Rows(NamedTuple):
    """Rows of a picture that are made together.

    Attributes:
        have: first and one past the last row that are sampled.
        want: the rows that are filtered from them.
    """

    have: tuple[int, int]
    want: tuple[int, int]


class Pass(NamedTuple):
    """Samples that are traced at once: some of every pixel of some rows.

    Attributes:
        rows: of the picture.
        first: number of the first sample of each pixel.
        spp: samples of each pixel.
        last: whether none of these rows follow.
    """

    rows: Rows
    first: int
    spp: int
    last: bool

    def rays(self, camera: Camera, seed: int) -> tuple[Samples, mi.Ray3f, mi.Point2f]:
        """Random numbers, rays, and offsets in the pixels; samples of a pixel side by side."""
        lane = dr.arange(mi.UInt32, self.lanes(camera))
        spp = dr.opaque(mi.UInt32, self.spp)
        within = lane // spp
        pixel = within + dr.opaque(mi.UInt32, self.rows.have[0] * camera.width)
        index = lane - within * spp + dr.opaque(mi.UInt32, self.first)
        samples = samples_of(dr.opaque(mi.UInt32, seed), pixel, index)
        return samples, *camera.rays_through(samples, pixel)

    def lanes(self, camera: Camera) -> int:
        """How many samples."""
        top, bottom = self.rows.have
        return (bottom - top) * camera.width * self.spp


def passes(camera: Camera, spp: int, border: int) -> Iterator[Pass]:
    """All samples of a picture, in bands of rows.

    Args:
        camera: whose pictures.
        spp: samples per pixel.
        border: rows beyond its own that a band needs for filtering.
    """
    width, height = camera.size
    number = math.ceil(spp / SPP_AT_ONCE)
    most = math.ceil(spp / number)
    rows = max(1, SAMPLES_AT_ONCE // (width * most) - 2 * border)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        band = Rows((max(top - border, 0), min(bottom + border, height)), (top, bottom))
        for first in range(0, spp, most):
            yield Pass(band, first, min(most, spp - first), first + most >= spp)

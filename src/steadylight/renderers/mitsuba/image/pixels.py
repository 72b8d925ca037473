"""Camera rays through the pixels of a picture, in bands of rows that bound memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.camera import Pose
from steadylight.renderers.mitsuba.frozen import frozen
from steadylight.renderers.mitsuba.memory import SAMPLES_AT_ONCE, SPP_AT_ONCE
from steadylight.renderers.mitsuba.sampling import Purpose, Samples, samples_of
from steadylight.renderers.mitsuba.scene import set_pose

Seen = Callable[[Samples, "mi.Ray3f"], Any]
"""(random numbers, camera rays) -> arrays of what the rays see, or a tuple of such."""


class Camera:
    """A sensor that moves along the camera path, and the size of its pictures.

    Attributes:
        sensor: mi.Sensor.
        size: width and height, pixels.
    """

    def __init__(self, sensor: mi.Sensor, size: tuple[int, int]) -> None:
        self.sensor = sensor
        self.size = size
        self._time = dr.opaque(mi.Float, 0.0)
        self._width = dr.opaque(mi.UInt32, size[0])
        self._scale = mi.Vector2f(dr.opaque(mi.Float, 1 / size[0]), dr.opaque(mi.Float, 1 / size[1]))

    def arrays(self) -> list[object]:
        """All that a kernel reads through this object, for `frozen`."""
        return [self.sensor, self._time, self._width, self._scale]

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return self.size[0]

    @property
    def pixels(self) -> int:
        """Pixels in a picture."""
        return self.size[0] * self.size[1]

    @property
    def frozen(self) -> bool:
        """Whether its kernels can be recorded: Dr.Jit does not traverse everything that other sensors hold."""
        return self.sensor.class_name() == "PerspectiveCamera"

    @property
    def random_aperture(self) -> bool:
        """Whether rays of a pixel start at random points on a lens."""
        return bool(self.sensor.needs_aperture_sample())

    def look(self, pose: Pose) -> None:
        """Move the sensor to a pose and to its time."""
        set_pose(self.sensor, pose)
        self._time = dr.opaque(mi.Float, pose.time)

    def rays(self, samples: Samples, position: mi.Point2f) -> mi.Ray3f:
        """Camera rays through film positions in [0, 1)², without weights: supported sensors have unit weight."""
        aperture = mi.Point2f(0.5)
        if self.random_aperture:
            aperture = samples.at(mi.UInt32(0), mi.UInt32(0)).sample_2d(Purpose.APERTURE)
        ray, _ = self.sensor.sample_ray(self._time, mi.Float(0.5), position, aperture)
        return ray

    def rays_through(self, samples: Samples, pixel: mi.UInt32) -> tuple[mi.Ray3f, mi.Point2f]:
        """Camera rays through random positions in pixels.

        Args:
            samples: their random numbers.
            pixel: of each sample, in row-major order.

        Returns:
            The rays, and the offset in the pixel, [0, 1)².
        """
        row = pixel // self._width
        column = pixel - row * self._width
        offset = samples.at(mi.UInt32(0), mi.UInt32(0)).sample_2d(Purpose.PIXEL)
        corner = mi.Point2f(mi.Float(column), mi.Float(row))
        return self.rays(samples, (corner + offset) * self._scale), offset


class Look:
    """A kernel that traces camera rays through pixels and returns what they see.

    Attributes:
        camera: source of the rays.
    """

    def __init__(self, camera: Camera, seen: Seen, state: Callable[[], list[Any]] | None = None) -> None:
        """Prepare the kernel.

        Args:
            camera: source of the rays; it may be moved between calls.
            seen: what the rays see.
            state: all that `seen` reads besides its arguments. If given, and if the camera's sensor allows it, Python
                traces the kernel only once (see `frozen`).
        """
        self.camera, self._seen = camera, seen
        self._trace = Look._traced
        if state is not None and camera.frozen:
            self._trace = frozen(Look._traced, lambda _: [*camera.arrays(), *state()])

    def __call__(self, samples: Samples, pixel: mi.UInt32) -> tuple[Any, mi.Point2f]:
        """The result of `seen`, with a named tuple as a plain one, and offsets in the pixels, [0, 1)².

        Args:
            samples: random numbers of each camera ray.
            pixel: of each ray, in row-major order.
        """
        dr.eval(samples.key, samples.index, pixel)
        found, offset = self._trace(self, samples, pixel)
        return found, offset

    def _traced(self, samples: Samples, pixel: mi.UInt32) -> tuple[Any, mi.Point2f]:
        ray, offset = self.camera.rays_through(samples, pixel)
        found = self._seen(samples, ray)
        found = tuple(found) if isinstance(found, tuple) else found
        dr.eval(found, offset)
        return found, offset


class Sampling(NamedTuple):
    """How a picture is sampled.

    Attributes:
        spp: samples per pixel.
        seed: determines all random numbers.
    """

    spp: int
    seed: int


class Rows(NamedTuple):
    """Rows of a picture that are processed together.

    Attributes:
        have: first and one past the last row that are sampled.
        want: the rows that are filtered from these.
    """

    have: tuple[int, int]
    want: tuple[int, int]

    @property
    def wanted(self) -> slice:
        """Slice of the wanted rows among the sampled ones."""
        return slice(self.want[0] - self.have[0], self.want[1] - self.have[0])


class Pass(NamedTuple):
    """Samples that are traced in one launch: some of every pixel of some rows.

    Attributes:
        rows: of the picture.
        first: index of the first sample of each pixel.
        spp: samples per pixel.
        last: whether this is the last pass over these rows.
    """

    rows: Rows
    first: int
    spp: int
    last: bool

    def samples(self, camera: Camera, seed: int) -> tuple[Samples, mi.UInt32]:
        """Random numbers and pixels, in row-major order; samples of a pixel are adjacent."""
        lane = dr.arange(mi.UInt32, self.lanes(camera))
        spp = dr.opaque(mi.UInt32, self.spp)
        within = lane // spp
        pixel = within + dr.opaque(mi.UInt32, self.first_pixel(camera.width))
        index = lane - within * spp + dr.opaque(mi.UInt32, self.first)
        return samples_of(dr.opaque(mi.UInt32, seed), pixel, index), pixel

    def rays(self, camera: Camera, seed: int) -> tuple[Samples, mi.Ray3f, mi.Point2f]:
        """Random numbers, rays, and offsets in the pixels."""
        samples, pixel = self.samples(camera, seed)
        return samples, *camera.rays_through(samples, pixel)

    def lanes(self, camera: Camera) -> int:
        """Number of samples."""
        return math.prod(self.shape(camera.width)) * self.spp

    def first_pixel(self, width: int) -> int:
        """Number of the first sampled pixel in the picture, in row-major order."""
        return self.rows.have[0] * width

    def shape(self, width: int) -> tuple[int, int]:
        """Number of sampled rows, and pixels per row."""
        top, bottom = self.rows.have
        return bottom - top, width


def passes(camera: Camera, spp: int, border: int) -> Iterator[Pass]:
    """All samples of a picture, in bands of rows.

    Args:
        camera: determines the size of the picture.
        spp: samples per pixel.
        border: additional rows above and below that a band needs for filtering.
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


def sign_of_half(index: mi.UInt32, spp: mi.UInt32) -> mi.Float:
    """1 for the first half of a pixel's samples, -1 for the second; 0 for the last of an odd number.

    Either half of a Sobol' set whose size is a power of two is such a set itself, so the difference of their means
    reflects the error of the sets, not that of independent samples.
    """
    half = spp // 2
    return dr.select(index < half, mi.Float(1), dr.select(index < 2 * half, mi.Float(-1), 0))

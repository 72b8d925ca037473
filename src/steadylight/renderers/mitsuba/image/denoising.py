"""Open Image Denoise for what the cache does not provide: direct light and glossy reflections.

It always runs on the CPU, whatever backend traced the frame, so that one machine has one result. Nor does the result
depend on the number of threads; on another CPU, the last bits may differ, as for all frames.
"""

from __future__ import annotations

import shlex
import sys
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, uniform_filter, zoom

from steadylight.errors import BackendError, SettingsError
from steadylight.images import luminance

Image = NDArray[np.float32]

MISSING: Final = (
    "--denoise needs Open Image Denoise; install it with "
    f"`{shlex.join([sys.executable, '-m', 'pip', 'install', 'pyoidn'])}`"
)

WINDOW: Final = 5
"""Edge of the window over which noise and the denoiser's error are compared, pixels."""

REGION: Final = 16.0
"""Standard deviation, in pixels, of the Gaussian mean over which the denoiser must preserve light: some 3000 pixels,
whose noise of 20 % each is 0.4 % of that mean."""

TRUST: Final = 1.5
"""Factor on the variance of the noise before it is compared with what was removed. Both are estimates: without the
factor, half of the places where the denoiser makes no error would appear to have one."""

OUTLYING: Final = 3.0
"""A pixel gets back at most this many times the root mean square of what was removed from its neighbours: for a line
one pixel wide through the window, 2.4 times that was removed."""

DOUBT: Final = 2.0
"""Standard errors by which a window, or a refined pixel, may differ from its denoised value by chance. With 1 or 3, the
error of frames was the same within 2 %; with 1, grain is left where noise has few and bright causes."""

DARK: Final = 1e-3
"""Fraction of the mean brightness below which errors are not relative to the local brightness."""

_BLOCK: Final = 16
"""Edge of the blocks over which noise is averaged before taking logarithms, pixels."""

_SMALL_BLOCK: Final = 4
"""Edge of the blocks from which means over `REGION` are computed, pixels: much smaller than that, but far fewer blocks
than pixels."""


def scale_of(picture: Image) -> float:
    """The factor that brings the mid-tones of a picture to where they were in the denoiser's training.

    The library would choose a factor for the picture that it denoises. If the direct light of a frame is two patches of
    sun, that picture is mostly black: the factor follows single noisy pixels, and the patches change with it from frame
    to frame.

    Args:
        picture: (height, width, 3) scene-linear RGB, the whole frame.

    Returns:
        0.18 over the geometric mean of the luminance of its blocks, without black ones.
    """
    blocks = _in_blocks(luminance(picture), _BLOCK, "edge")
    lit = blocks[blocks > 1e-8]
    # Rounded, since sums may differ in their last bits between CPUs.
    return float(f"{0.18 / np.exp(np.log(lit).mean()):.4g}") if lit.size else 1.0


def mixed(noisy: Image, clean: Image, noise: Image, refined: NDArray[np.bool_] | None = None) -> Image:
    """The mixture of a noisy picture and its denoised version with the least error.

    The denoiser takes some fine and dim detail for noise: the shadow of a wire, a texture in the sun. Let S be the mean
    square of what the denoiser removed, and E the part of it that is the denoiser's own error, squared: E / S is the
    best weight of the noisy picture (after James & Stein 1961). Two halves of a pixel's samples share that error, but
    not their noise. So E is the mean product of the differences of both from the denoised picture, as far as noise of
    this variance would not reach it by chance. All are means over a window without its maximum: a single pixel in which
    both halves found a firefly is not texture.

    Args:
        noisy: (height, width, 3), at least 0.
        clean: (height, width, 3), denoised from `noisy`.
        noise: (height, width, 3) an independent sample of the error of `noisy`; see `Rendered.noise`.
        refined: (height, width) mask of adaptively sampled pixels. A denoiser replaces their glints and edges with the
            surroundings, so each is judged by itself.
    """

    def around(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        # The filter's running sums may end slightly below 0.
        mean: NDArray[np.float64] = uniform_filter(values.astype(np.float64), WINDOW)
        return np.maximum(mean, 0)

    def without_greatest(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        greatest = maximum_filter(values.astype(np.float64), WINDOW)
        return np.maximum(around(values) * WINDOW**2 - greatest, 0) / (WINDOW**2 - 1)

    brightness = luminance(clean).astype(np.float64)
    if not brightness.any():
        return clean
    level = around(brightness) + DARK * brightness.mean()
    difference = noisy - clean
    removed, variance = (np.square(luminance(each) / level) for each in (difference, noise))
    taken = without_greatest(removed)
    # The halves are the mean plus and minus the noise. Each has twice its variance, and so has their product's root.
    chance = 2 * without_greatest(variance) / WINDOW
    own = np.maximum(without_greatest(removed - variance) - DOUBT * chance, 0)
    back = np.divide(np.minimum(own, taken), taken, out=np.zeros_like(taken), where=taken > 0)
    # No more of a firefly is restored than of its neighbours.
    most = OUTLYING * np.sqrt(taken) * level
    size = np.abs(luminance(difference))
    back *= np.divide(most, size, out=np.ones_like(size), where=size > most)
    if refined is not None and refined.any():
        back = np.where(refined, np.maximum(back, _told(difference, noise, refined)), back)
    mixture: Image = clean + difference * back[..., None].astype(np.float32)
    return mixture


def _told(difference: Image, noise: Image, refined: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fraction of a pixel's difference from its denoised value that cannot be noise; (height, width).

    The noise of a refined pixel is taken to be that of the refined pixels around it, or its own if larger.
    """
    square = np.square(luminance(noise), dtype=np.float64)
    share = uniform_filter(refined.astype(np.float64), WINDOW)
    usual = uniform_filter(np.where(refined, square, 0), WINDOW)
    variance = np.maximum(np.divide(usual, share, out=np.zeros_like(share), where=refined), square)
    taken = np.square(luminance(difference), dtype=np.float64)
    return 1 - np.divide(
        DOUBT**2 * variance, taken, out=np.ones_like(taken), where=taken > DOUBT**2 * variance
    )


def balanced(noisy: Image, clean: Image, noise: Image, cut: Image) -> Image:
    """The denoised picture, corrected for light that the denoiser lost or added, and for light clamped from fireflies.

    The denoiser takes few very bright samples for outliers and removes their light. Over many pixels, noise averages
    out, so a difference of the means is the denoiser's own error. It is restored in proportion to noise and light, and
    with the weight 1 - V / S: S is the square of the difference of the means, V the variance of a mean.

    Args:
        noisy: (height, width, 3), at least 0.
        clean: (height, width, 3), denoised from `noisy`.
        noise: (height, width, 3) an independent sample of the error of `noisy`; see `Rendered.noise`.
        cut: (height, width, 3) what was clamped from fireflies. Most of it came from single paths: its error is as
            large as itself.

    Returns:
        (height, width, 3), at least 0.
    """
    height, width = clean.shape[:2]
    sigma = REGION / _SMALL_BLOCK

    def weighted(blocks: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        """Sums with Gaussian weights, which sum to 1 away from the border."""
        along = (sigma, sigma, 0)[: blocks.ndim]
        return np.asarray(gaussian_filter(blocks, along, mode="constant"))

    # A pixel that is not finite must not spoil its neighbours.
    error = noisy + cut - clean
    error[~np.isfinite(error)] = 0
    squared = np.nan_to_num(np.square(luminance(noise)) + np.square(luminance(cut)), posinf=0)
    brightness = luminance(clean)
    real, errors, squares, light = (
        _in_blocks(values, _SMALL_BLOCK, "constant")
        for values in (np.ones((height, width), np.float32), error, squared, brightness)
    )
    share = weighted(real, sigma)  # less than 1 at the border
    lost = weighted(errors, sigma) / share[..., None]
    # Squared Gaussian weights are a Gaussian narrower by sqrt(2), divided by 4 pi sigma².
    variance = weighted(squares / _SMALL_BLOCK**2, sigma / np.sqrt(2)) / (4 * np.pi * sigma**2)
    variance *= TRUST / share**2
    square = np.square(luminance(lost))
    part = np.divide(square - variance, square, out=np.zeros_like(square), where=square > variance)
    here = np.sqrt(weighted(squares, sigma / 2) / weighted(real, sigma / 2))
    around = weighted(here * light, sigma) / share
    part *= np.divide(here, around, out=np.zeros_like(here), where=around > 0)
    scale = (_SMALL_BLOCK, _SMALL_BLOCK, 1)
    given = zoom(lost * part[..., None], scale, order=1, mode="nearest", grid_mode=True)
    return np.maximum(clean + brightness[..., None] * given[:height, :width], 0).astype(np.float32)


def _in_blocks(
    values: NDArray[np.floating[Any]], side: int, margin: Literal["edge", "constant"]
) -> NDArray[np.float64]:
    """Means of blocks of `side` x `side` pixels, padded at the border with the last pixels or with zeros."""
    height, width, *more = values.shape
    beyond = [(0, -height % side), (0, -width % side)] + [(0, 0)] * len(more)
    padded = np.pad(values, beyond, mode=margin)
    blocks = padded.reshape(padded.shape[0] // side, side, padded.shape[1] // side, side, *more)
    means: NDArray[np.float64] = blocks.mean((1, 3), dtype=np.float64)
    return means


def check_denoiser() -> None:
    """Check that there is a denoiser on this machine.

    Raises:
        SettingsError: there is none; says what to install.
    """
    try:
        Denoiser(threads=1)
    except BackendError as error:
        raise SettingsError(str(error)) from error


class Denoiser:
    """Open Image Denoise, loaded and initialised."""

    def __init__(self, threads: int, *, thorough: bool = False) -> None:
        """Load the library.

        Args:
            threads: number of threads.
            thorough: use the larger of its networks, which takes twice as long.

        Raises:
            BackendError: it is missing, or does not work here; says what to install.
        """
        try:
            import pyoidn

            device = pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CPU)
            device.set_int("numThreads", threads)
            # With affinity, the threads of all workers of a machine would be pinned to the same first cores.
            device.set_bool("setAffinity", value=False)
            device.commit()
            fault = device.get_error()
        except (ImportError, OSError) as error:
            raise BackendError(f"{MISSING} ({error})") from error
        if fault is not None:
            raise BackendError(f"--denoise: Open Image Denoise does not work here: {fault}")
        self._device = device
        self._quality = pyoidn.OIDN_QUALITY_HIGH if thorough else pyoidn.OIDN_QUALITY_BALANCED

    def clean(self, color: Image, albedo: Image, normal: Image, *, scale: float, prefilter: bool) -> Image:
        """Denoise a picture.

        Args:
            color: (height, width, 3) scene-linear RGB, at least 0, with a filter no wider than a pixel: noise that is
                correlated between pixels is taken for texture.
            albedo: (height, width, 3) from 0 to 1.
            normal: (height, width, 3) from -1 to 1.
            scale: of the frame that it belongs to; see `scale_of`.
            prefilter: whether albedo and normal are noisy and must be denoised first: three times the work.

        Returns:
            (height, width, 3), at least 0.

        Raises:
            BackendError: the library failed.
        """
        if not color.any():
            return np.zeros_like(color)  # it would turn black into a faint glow
        if prefilter:
            albedo, normal = self._run({"albedo": albedo}), self._run({"normal": normal})
        return self._run({"color": color, "albedo": albedo, "normal": normal}, scale)

    def _run(self, images: dict[str, Image], scale: float = 1.0) -> Image:
        """Denoise the first of the images."""
        import pyoidn

        images = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
        result = np.zeros_like(next(iter(images.values())))
        filter_: Any = pyoidn.Filter(self._device, pyoidn.OIDN_FILTER_TYPE_RT)
        try:
            for name, image in (images | {"output": result}).items():
                filter_.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
            if "color" in images:
                filter_.set_bool("hdr", value=True)
                filter_.set_bool("cleanAux", value=True)
                filter_.set_float("inputScale", scale)
            filter_.set_quality(self._quality)
            filter_.commit()
            filter_.execute()
            fault = self._device.get_error()
        finally:
            filter_.release()
        if fault is not None:
            raise BackendError(f"--denoise: Open Image Denoise failed: {fault}")
        return result

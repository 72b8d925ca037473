"""What `--quality` stands for in the options of Radiance's programs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from steadylight.settings import RenderSettings

REDUNDANT: Final = 0.25
"""A record is redundant if a better one lies within this fraction of the smaller reach of the two. The reach is `-aa`
times the radius."""

WORKING: Final = {
    "-av": "0 0 0",  # no constant ambient light
    "-dj": 1,  # smaller values do not sample the edges of area sources
    "-dt": 0.03,
    "-dc": 0.75,
    # Rough gloss reflects lamps and ambient light but is not sampled. Radiance seeds such samples with the address of
    # the material, so they would differ between processes. Smooth gloss and glass reflect and refract as usual.
    "-st": 1,
    "-u-": "",  # otherwise rtrace seeds its random numbers by the clock
    "-w": "",
}
"""Options that do not depend on quality."""


@dataclass(frozen=True)
class AmbientOptions:
    """Options that trade time for error, spaced as the low, medium and high quality of Radiance's own `rad`.

    Attributes:
        accuracy: `-aa`, error tolerance; the reach of a record is this times its radius.
        divisions: `-ad`, rays per record.
        supersamples: `-as`, further rays where neighbouring divisions differ.
        resolution: `-ar`: the smallest radius is the side of the scene's octree over this.
        sources: `-ds`: size over distance beyond which a part of an area source is subdivided.
        weight: `-lw`, minimum weight of rays.
    """

    accuracy: float
    divisions: int
    supersamples: int
    resolution: int
    sources: float
    weight: float


def ambient_options(q: float) -> AmbientOptions:
    """Options for a quality: 1 is normal; see `steadylight.quality`.

    The relative error of interpolation grows with the square of `-aa`, the noise of a record falls with the square root
    of `-ad`: both shrink at about the same rate.
    """
    divisions = max(64, round(512 * math.sqrt(q)))
    return AmbientOptions(
        accuracy=round(0.2 * q**-0.3, 4),
        divisions=divisions,
        supersamples=divisions // 4,
        resolution=max(16, round(128 * math.sqrt(q))),
        sources=round(0.35 * q**-0.25, 4),
        weight=float(f"{1e-4 / q:.3g}"),
    )


AUTO_BOUNCES = 6
"""`-ab` for `--bounces auto`. Radiance traces rays for each bounce, so the number must be fixed; six leave out less
than 1 % of the light of a closed room whose surfaces reflect half of it."""


@dataclass(frozen=True)
class Options:
    """All options of `rtrace` except its rays and the ambient file.

    Attributes:
        ambient: options that depend on quality.
        bounces: `-ab`; one more than requested under a sky that is a `glow`, whose light only ambient rays find.
        depth: `-lr`, maximum number of reflections of a ray.
        oversampling: columns and rows of samples per pixel.
    """

    ambient: AmbientOptions
    bounces: int
    depth: int
    oversampling: int

    @classmethod
    def of(cls, settings: RenderSettings, *, sky: bool) -> Options:
        """Options for some settings; `sky` if there is light from a `glow` all around."""
        return cls(
            ambient=ambient_options(settings.quality),
            bounces=(AUTO_BOUNCES if settings.bounces == "auto" else settings.bounces) + sky,
            depth=settings.depth,
            oversampling=max(1, round(math.sqrt(settings.spp))),
        )

    def words(self) -> list[str]:
        """The options as command-line arguments; the first two are `-ab` and its value."""
        values = {
            "-ab": self.bounces,
            "-aa": self.ambient.accuracy,
            "-ad": self.ambient.divisions,
            "-as": self.ambient.supersamples,
            "-ar": self.ambient.resolution,
            "-ds": self.ambient.sources,
            "-lr": self.depth,
            "-lw": self.ambient.weight,
        } | WORKING
        return [word for option, value in values.items() for word in (option, *str(value).split())]

    def words_without_cache(self) -> list[str]:
        """Likewise for the baseline without a cache: one ambient ray per reflection, as in a path tracer."""
        words = self.words()
        for option, value in (("-aa", "0"), ("-ad", "1"), ("-as", "0")):
            words[words.index(option) + 1] = value
        return words

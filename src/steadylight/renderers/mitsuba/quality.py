"""All that the one number of quality decides in this renderer: budgets and tolerances.

With `q` = 1 each formula gives the value it is written with. Tolerances of the records shrink with the square root of
`q`, so that the number of paths a record needs grows with `q`; counts of samples that are a small part of the work grow
more slowly. The table of all constants, those that quality leaves alone too, is docs/quality-settings.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import floor, isqrt, log2, sqrt

from steadylight.cache.smoothing import Smoothing
from steadylight.settings import Radii, RenderSettings, SolidPanes


@dataclass(frozen=True)
class RecordQuality:
    """How irradiance records are made.

    Attributes:
        polar_strata: M, strata in elevation of the cosine-weighted hemisphere (Ward & Heckbert 1992).
        azimuth_strata: N, strata in azimuth. A record takes M*N pilot samples, one to a stratum.
        refinement_paths: further paths, sent where pilot samples saw light, or emitter samples the sky: each record
            takes one of these numbers, by its noise. Ascending, at least M*N each, and square, since their shared
            multijitter point set is a grid.
        standard_error: relative standard error that a record's number of paths aims at, as far as pilot and emitter
            samples can tell; less is asked of faint light (see `Gather`), and of records at their smallest radius,
            whose neighbours share their noise.
        radii: what a record's radius goes by: split-sphere, the harmonic mean distance of what its hemisphere sees
            (Ward, Rubinstein & Clear 1988); or occlusion-hessian, the second derivative of irradiance (Schwarzhaupt,
            Jensen & Jarosz 2012).
        accuracy: a; the radius is `a` times that.
        clamped: no radius passes the nearest surface that stands over the record; off as published.
        minimum_spacing: smallest radius, in pixels of the camera that comes nearest on the whole path.
        maximum_spacing: largest radius, as a fraction of the scene's diagonal.
        emitter_samples: at the first hit of each path.
    """

    polar_strata: int = 10
    azimuth_strata: int = 40
    refinement_paths: tuple[int, ...] = (400, 784, 1600, 3136)
    standard_error: float = 0.033
    radii: Radii = "occlusion-hessian"
    accuracy: float = 0.15
    clamped: bool = True
    minimum_spacing: float = 1.6
    maximum_spacing: float = 0.05
    emitter_samples: int = 1

    def __post_init__(self) -> None:
        paths = self.refinement_paths
        assert paths, "no number of paths"
        assert all(count >= self.strata and isqrt(count) ** 2 == count for count in paths), paths
        assert list(paths) == sorted(set(paths)), paths

    @property
    def strata(self) -> int:
        """M*N."""
        return self.polar_strata * self.azimuth_strata

    @property
    def paths_per_record(self) -> tuple[int, int]:
        """Pilot and refinement paths together, of a quiet record and of a noisy one."""
        return self.strata + self.refinement_paths[0], self.strata + self.refinement_paths[-1]


@dataclass(frozen=True)
class ShadingQuality:
    """Samples of paths from the camera, and of the tables that guide emitter sampling.

    Attributes:
        emitter_samples: at the surface that a camera ray meets first, itself or through clear glass; one further on.
        glossy_samples: directions drawn from the BSDF of that surface if it has a glossy lobe; one further on, and from
            a rough layer over a diffuse base.
        sky_samples: directions in which such a layer looks for the cached sky. Each is a BSDF sample and a shadow ray,
            a fraction of what a path costs.
        negligible: a scattered path whose throughput fell below this goes on by Russian roulette.
        emitter_rays: shadow rays from each record, and from each point that fills the gather's grid, over all patches
            of emitters.
        firefly: what one path may add to its pixel, in mean luminances of the picture around it.
    """

    emitter_samples: int = 3
    glossy_samples: int = 4
    sky_samples: int = 8
    negligible: float = 0.05
    emitter_rays: int = 512
    firefly: float = 1.0


@dataclass(frozen=True)
class AdaptiveSamples:
    """Which pixels get more samples, and how many.

    Attributes:
        threshold: what is compared with it is told where each is used.
        pixels: largest part of the picture's pixels that are sampled again.
        rays: most rays that this may cost, as a multiple of the picture's own; four times as many samples as the
            picture has are taken in any case.
    """

    threshold: float
    pixels: float
    rays: float


@dataclass(frozen=True)
class AdaptiveQuality:
    """More samples where a few pixels have most of the noise.

    Attributes:
        direct: where the standard error of direct light, in a pixel or beside it, is more than `threshold` of the
            picture there, and far more than that of most pixels. The noisiest get up to 64 times as many samples as the
            least noisy of these.
        rest: likewise of what gloss and clear glass show, with the secondary cache in place of records. A sample costs
            five times as much.
        worth: least part that these pixels have in the noise of a picture, as a root mean square relative to what is
            around, for `rest` to be sampled again. With less, a gallery's error was the same, and a kernel compiled.
        emission: where visible emission differs among neighbours by `threshold` of the picture's mean luminance. A
            window may send most of the light of a picture, and its rays cost a tenth of those that ask what is lit.
        emission_samples: of each pixel there. While `rays` were more, they are halved.
    """

    direct: AdaptiveSamples = AdaptiveSamples(threshold=0.05, pixels=1 / 8, rays=1.0)
    rest: AdaptiveSamples = AdaptiveSamples(threshold=0.05, pixels=1 / 32, rays=0.25)
    worth: float = 0.01
    emission: AdaptiveSamples = AdaptiveSamples(threshold=0.25, pixels=1.0, rays=2.0)
    emission_samples: int = 256


@dataclass(frozen=True)
class SurfaceQuality:
    """How the first pass by surfaces looks, and what is worth a record afterwards.

    Attributes:
        weakest: part of a path's throughput below which no less is asked for: a mirror of 4 % asks for records with 5
            times the radius, one of 1 % or less for 8 times.
        faint: share of a sample below which what gloss shows is answered by the secondary cache.
        enough: so many look-ups without an answer within a record's smallest radius, over all samples of all frames,
            make it worth a record.
        added: of the numbers of refinement paths, so many, the lowest, are for the records that are made afterwards.
            These answer some twenty times fewer look-ups each: their noise hardly counts in a picture.
        stretched: part of the camera samples, at most, whose look-ups are answered by records further off.
    """

    weakest: float = 1 / 64
    faint: float = 0.1
    enough: int = 6
    added: int = 2
    stretched: float = 1e-3


@dataclass(frozen=True)
class DenoisingQuality:
    """What the denoiser may cost.

    Attributes:
        large_network: the larger of its networks, which takes twice as long.
    """

    large_network: bool = False


@dataclass(frozen=True)
class MitsubaQuality:
    """One quality, whole: the defaults of each part are those of 1, normal.

    How light passes solid `panes` is no matter of quality, but of the method.
    """

    number: float = 1.0
    records: RecordQuality = RecordQuality()
    secondary: RecordQuality = field(default_factory=lambda: secondary_records(1.0))
    smoothing: Smoothing = field(default_factory=Smoothing)
    surfaces: SurfaceQuality = SurfaceQuality()
    shading: ShadingQuality = ShadingQuality()
    adaptive: AdaptiveQuality = AdaptiveQuality()
    denoising: DenoisingQuality = DenoisingQuality()
    panes: SolidPanes = "refract"


def mitsuba_quality(q: float, radii: Radii = "occlusion-hessian") -> MitsubaQuality:
    """Budgets and tolerances for a quality.

    Args:
        q: 1 is normal; see `steadylight.quality`.
        radii: what the radius of records goes by; no matter of quality, but of the method.
    """
    return MitsubaQuality(
        number=q,
        records=_records(q, radii),
        secondary=secondary_records(q),
        smoothing=Smoothing(tolerance=0.1 * q ** (-1 / 3)),
        shading=ShadingQuality(
            emitter_samples=_count(3, q ** (1 / 3)),
            glossy_samples=_count(4, q ** (1 / 3)),
            sky_samples=_count(8, q ** (1 / 3)),
            negligible=0.05 / q,
            emitter_rays=_count(512, sqrt(q)),
            firefly=sqrt(q),
        ),
        adaptive=AdaptiveQuality(
            direct=AdaptiveSamples(0.05 / sqrt(q), pixels=min(sqrt(q) / 8, 1.0), rays=sqrt(q)),
            rest=AdaptiveSamples(0.05 / sqrt(q), pixels=min(sqrt(q) / 32, 1.0), rays=sqrt(q) / 4),
            worth=0.01 / sqrt(q),
            emission=AdaptiveSamples(0.25 / sqrt(q), pixels=1.0, rays=2 * sqrt(q)),
            emission_samples=_count(256, sqrt(q)),
        ),
        denoising=DenoisingQuality(large_network=q > 1),
    )


def quality_of(settings: RenderSettings) -> MitsubaQuality:
    """The quality that settings ask for; a short film has records further apart, but for the published first pass."""
    quality = replace(mitsuba_quality(settings.quality, settings.radii), panes=settings.panes)
    spacing = quality.records.minimum_spacing * settings.record_spacing
    return replace(quality, records=replace(quality.records, minimum_spacing=spacing))


def _records(q: float, radii: Radii) -> RecordQuality:
    """Records of the cache: their number grows as `q` to 1.6 where pixels bound it, and paths of each as `q`."""
    strata = _count(10, q ** (1 / 6))
    # The numbers of paths double from M*N on; noisier records may ask for more steps at higher quality.
    steps = max(1, floor(4.5 + log2(q) / 2))
    return RecordQuality(
        polar_strata=strata,
        azimuth_strata=4 * strata,
        refinement_paths=tuple((2 * round(strata * sqrt(2) ** step)) ** 2 for step in range(steps)),
        standard_error=0.033 / sqrt(q),
        radii=radii,
        accuracy=0.15 / sqrt(q),
        minimum_spacing=1.6 * q**-0.8,
        emitter_samples=_count(1, q ** (1 / 3)),
    )


def secondary_records(q: float) -> RecordQuality:
    """Records of the secondary cache, which gather paths ask at the surfaces that they hit.

    They are few and coarse, since a gather averages over all that its hemisphere sees, and hardly change with quality.
    Twice as far apart, they were 1 to 1.7 % too dark. A few of them beside windows decide how bright a whole room is:
    with fewer than half as many paths, an office varied by 2.6 % from seed to seed instead of 1.8 %.
    """
    strata = _count(9, q ** (1 / 6))
    return RecordQuality(
        polar_strata=strata,
        azimuth_strata=4 * strata,
        refinement_paths=((4 * strata) ** 2,),
        radii="split-sphere",
        accuracy=0.3 * q**-0.2,
        minimum_spacing=12.0 * q**-0.2,
        emitter_samples=_count(2, q ** (1 / 3)),
    )


def _count(at_normal: int, factor: float) -> int:
    """A whole number of at least 1."""
    return max(1, round(at_normal * factor))

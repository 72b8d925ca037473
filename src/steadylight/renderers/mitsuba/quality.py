"""Budgets and tolerances of this renderer, as functions of the one quality number.

With `q` = 1, each formula gives the value written in it. Tolerances of records shrink with the square root of `q`, so
that the paths of a record grow with `q`. Sample counts that are a small part of the work grow more slowly. All
constants, including those that do not depend on quality, are listed in docs/quality-settings.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import floor, log2, sqrt

from steadylight.cache.smoothing import Smoothing
from steadylight.settings import Radii, RenderSettings, SolidPanes


@dataclass(frozen=True)
class RecordQuality:
    """How irradiance records are made.

    Attributes:
        polar_strata: M, strata in elevation of the cosine-weighted hemisphere (Ward & Heckbert 1992).
        azimuth_strata: N, strata in azimuth. A record takes M*N pilot samples, one per stratum.
        refinement_paths: further paths, sent where pilot samples saw light or emitter samples the sky: each record
            takes one of these numbers, by its noise. Ascending, at least M*N each.
        standard_error: target for the relative standard error of a record, which decides its number of paths, estimated
            from pilot and emitter samples. It is relaxed for faint light (see `Gather`), and for records at their
            smallest radius, since look-ups average their noise with that of close neighbours.
        radii: measure that determines a record's radius: split-sphere, the harmonic mean distance of the surfaces that
            its hemisphere sees (Ward, Rubinstein & Clear 1988); or occlusion-hessian, the second derivative of
            irradiance (Schwarzhaupt, Jensen & Jarosz 2012).
        accuracy: a; the radius is `a` times that measure.
        clamped: whether no radius exceeds the distance to the nearest surface above the record; off as published.
        minimum_spacing: smallest radius, in pixels of the camera that comes nearest on the whole path.
        maximum_spacing: largest radius, as a fraction of the scene's diagonal.
        emitter_samples: emitter samples at the first hit of each path.
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
        assert all(count >= self.strata for count in paths), paths
        assert list(paths) == sorted(set(paths)), paths

    @property
    def strata(self) -> int:
        """M*N."""
        return self.polar_strata * self.azimuth_strata

    @property
    def paths_per_record(self) -> tuple[int, int]:
        """Pilot and refinement paths together, for the least and the most noisy records."""
        return self.strata + self.refinement_paths[0], self.strata + self.refinement_paths[-1]


@dataclass(frozen=True)
class ShadingQuality:
    """Sample counts of camera paths, and of the tables that guide emitter sampling.

    Attributes:
        emitter_samples: at the surface that the camera sees, directly or through clear glass; one at later surfaces.
        glossy_samples: directions sampled from that surface's BSDF if it has a glossy lobe; one at later surfaces, and
            from a rough layer over a diffuse base.
        sky_samples: directions in which such a layer looks for the cached sky. Each is a BSDF sample and a shadow ray,
            a fraction of the cost of a path.
        negligible: throughput below which Russian roulette applies to scattered paths.
        emitter_rays: shadow rays to all patches of emitters, from each record and each point that fills the gather's
            grid.
        firefly: most that one path may add to its pixel, in mean luminances of the surrounding picture.
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
        threshold: error or contrast above which a pixel qualifies; its meaning differs by use, see `AdaptiveQuality`.
        pixels: maximum fraction of the picture's pixels that are sampled again.
        rays: maximum cost in rays, as a multiple of the picture's own; exceeded where needed to take four times as many
            samples as the picture has.
    """

    threshold: float
    pixels: float
    rays: float


@dataclass(frozen=True)
class AdaptiveQuality:
    """Adaptive sampling, for a few pixels that have most of the noise.

    Attributes:
        direct: applies where the standard error of direct light, in a pixel or a neighbour, exceeds `threshold`
            relative to the surrounding picture, and is far above that of most pixels. The noisiest of these pixels get
            up to 64 times as many samples as the least noisy.
        rest: likewise for what glossy reflection and clear glass show, with the secondary cache in place of records. A
            sample costs five times as much.
        worth_rest: `rest` is sampled again only if these pixels contribute at least this much noise to the picture, as
            a root mean square relative to the surroundings. Below, the error of a gallery scene did not improve, and it
            cost the compilation of a kernel.
        indirect: as `direct`, for light from the cache, where surfaces or textures differ within a pixel. A sample is a
            camera ray and a look-up, a third of the cost of a sample that shades.
        worth_indirect: as `worth_rest`, for `indirect`, among the rows that are processed together. The noise is the
            error by which pixels are judged: two to four times too high, since it takes samples for independent and the
            maximum of neighbours. Where it is lower, as in a gallery lit by lamps, more samples removed 1 % of a
            frame's noise for 7 % of its time.
        emission: applies where visible emission differs among neighbours by `threshold` times the picture's mean
            luminance. A window may send most of the light of a picture, and its rays cost a tenth of rays that shade.
        emission_samples: samples of each such pixel, halved until they cost at most `rays`.
    """

    direct: AdaptiveSamples = AdaptiveSamples(threshold=0.05, pixels=1 / 8, rays=1.0)
    rest: AdaptiveSamples = AdaptiveSamples(threshold=0.05, pixels=1 / 32, rays=0.25)
    worth_rest: float = 0.01
    indirect: AdaptiveSamples = AdaptiveSamples(threshold=0.02, pixels=1 / 8, rays=0.5)
    worth_indirect: float = 0.02
    emission: AdaptiveSamples = AdaptiveSamples(threshold=0.25, pixels=1.0, rays=2.0)
    emission_samples: int = 256


@dataclass(frozen=True)
class SurfaceQuality:
    """First pass by surfaces: which radii paths request, and which misses get a record afterwards.

    Attributes:
        weakest: path throughput below which the requested radius no longer grows: a mirror of 4 % requests records of
            5 times the radius, one of 1 % or less of 8 times.
        faint: surfaces whose share of a sample, by glossy reflection, is below this use the secondary cache.
        seen_by: a surface that so many frames see from the nearest distance has records of the smallest radius. Where
            fewer look-ups fall, records are larger: see `coverage.worth_look_ups`. In films of fewer than `FEW_FRAMES`
            frames, the number falls with theirs.
        enough: number of misses within a record's smallest radius, over all samples of all frames, that makes them
            worth a record.
        added: records that are made afterwards choose among this many of the lowest numbers of refinement paths. They
            serve some twenty times fewer look-ups each, so their noise hardly matters.
        stretched: maximum fraction of the camera samples whose look-ups may be served by stretched records.
    """

    weakest: float = 1 / 64
    faint: float = 0.1
    seen_by: float = 50.0
    enough: int = 6
    added: int = 2
    stretched: float = 1e-3


@dataclass(frozen=True)
class DenoisingQuality:
    """Cost of the denoiser.

    Attributes:
        large_network: use the larger of its networks, which takes twice as long.
    """

    large_network: bool = False


@dataclass(frozen=True)
class MitsubaQuality:
    """All parameters of one quality; the defaults of each part are those of quality 1, normal.

    How light passes solid `panes` is a choice of method, not of quality.
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
    """Budgets and tolerances of a quality.

    Args:
        q: 1 is normal; see `steadylight.quality`.
        radii: measure of the records' radius, a choice of method rather than quality.
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
            worth_rest=0.01 / sqrt(q),
            indirect=AdaptiveSamples(0.02 / sqrt(q), pixels=min(sqrt(q) / 8, 1.0), rays=sqrt(q) / 2),
            worth_indirect=0.02 / sqrt(q),
            emission=AdaptiveSamples(0.25 / sqrt(q), pixels=1.0, rays=2 * sqrt(q)),
            emission_samples=_count(256, sqrt(q)),
        ),
        denoising=DenoisingQuality(large_network=q > 1),
    )


def quality_of(settings: RenderSettings) -> MitsubaQuality:
    """The quality of some settings; short films space records wider, except in the published first pass."""
    quality = replace(mitsuba_quality(settings.quality, settings.radii), panes=settings.panes)
    spacing = quality.records.minimum_spacing * settings.record_spacing
    return replace(quality, records=replace(quality.records, minimum_spacing=spacing))


def _records(q: float, radii: Radii) -> RecordQuality:
    """Records of the cache: their number grows as q^1.6 where pixels bound it, and the paths of each as q."""
    strata = _count(10, q ** (1 / 6))
    # The numbers of paths double, beginning at M*N; higher quality adds steps for the noisiest records.
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
    """Records of the secondary cache, which gather paths look up at the surfaces that they hit.

    They are few and coarse, and hardly change with quality, since a gather averages over its hemisphere. More records
    of fewer paths are better than fewer of more: corners are too bright if records are far apart, and those whose noise
    would show in the brightness of a whole room get further paths by their importance (docs/experiments.md).
    """
    strata = _count(5, q ** (1 / 6))
    return RecordQuality(
        polar_strata=strata,
        azimuth_strata=4 * strata,
        refinement_paths=((4 * strata) ** 2,),
        radii="split-sphere",
        accuracy=0.2 * q**-0.2,
        minimum_spacing=9.0 * q**-0.2,
        emitter_samples=_count(2, q ** (1 / 3)),
    )


def _count(at_normal: int, factor: float) -> int:
    """An integer of at least 1."""
    return max(1, round(at_normal * factor))

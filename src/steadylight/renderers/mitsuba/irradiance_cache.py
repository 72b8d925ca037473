"""The Mitsuba integrator plugin `irradiance_cache`, for use in `mi.load_dict` and `mi.render`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

_registered: set[str] = set()


def register() -> None:
    """Register `{'type': 'irradiance_cache'}` with Mitsuba under the current variant; harmless to repeat.

    The class must be defined in this function: Mitsuba's base classes do not exist before a variant is set.
    """
    variant = mi.variant()
    if variant in _registered:
        return

    from steadylight.cache.file import read_cache
    from steadylight.cache.records import Records
    from steadylight.cache.smoothing import smooth
    from steadylight.camera import Pose
    from steadylight.quality import quality_number, quality_word
    from steadylight.renderers.mitsuba.coverage import fill_view, make_filler
    from steadylight.renderers.mitsuba.image.pixels import Camera
    from steadylight.renderers.mitsuba.quality import mitsuba_quality
    from steadylight.renderers.mitsuba.records.lookup import DeviceCache
    from steadylight.renderers.mitsuba.sampling import samples_of
    from steadylight.renderers.mitsuba.scene import field_of_view
    from steadylight.renderers.mitsuba.view import View

    class IrradianceCache(mi.SamplingIntegrator):
        """Indirect diffuse light from an irradiance cache, everything else by path tracing.

        The cache is filled for the sensor when `render` is first called, and kept: further renders with the same
        integrator, from any sensor, only add records that are still missing.

        Parameters (all optional):

        * `bounces` (int): indirect diffuse bounces; -1 for all. Default: -1.
        * `depth` (int): maximum number of mirrors, glass and glossy surfaces along a path. Default: 12.
        * `quality` (string): `draft`, `normal`, `high`, or a number. Default: `normal`.
        * `filename` (string): a cache file made by steadylight, to start from. Default: an empty cache.

        ```python
        import mitsuba as mi, steadylight as sl
        sl.use_variant("llvm_ad_rgb")
        scene = mi.load_dict({**mi.cornell_box(), "integrator": {"type": "irradiance_cache"}})
        image = mi.render(scene, spp=16)
        ```
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.bounces = int(props.get("bounces", -1))
            self.depth = int(props.get("depth", 12))
            quality = props.get("quality", "normal")
            filename = str(props.get("filename", ""))
            if self.bounces < -1 or self.depth < 1:
                raise ValueError("irradiance_cache: bounces must be at least -1 and depth at least 1")
            try:
                self.quality = quality_number(quality)
            except ValueError as error:
                raise ValueError(f"irradiance_cache: quality: {error}") from None
            self.records = read_cache(Path(filename)).records if filename else Records.empty()
            self._cache: Any = None
            self._view: Any = None

        def fill(self, scene: Any, sensor: Any, seed: int = 0) -> None:
            """Make the records that a sensor's view needs and the cache lacks."""
            width, height = (int(n) for n in sensor.film().crop_size())
            to_world = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
            pose = Pose(to_world, field_of_view(sensor))
            camera = Camera(sensor, (width, height))
            self._view = View(scene, camera, self.depth, mitsuba_quality(self.quality))
            self._view.still = False  # the caller owns the scene and may change it
            if self.bounces:
                filler = make_filler(self._view, [pose], None if self.bounces < 0 else self.bounces)
                known = DeviceCache(self.records)
                self.records = fill_view(self._view, filler, known, seed).records
                self._cache = DeviceCache(
                    smooth(self.records, smoothing=self._view.quality.smoothing)
                ).with_fallback()

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Fill the cache for the sensor, then render like any integrator."""
            if isinstance(sensor, int):
                sensor = scene.sensors()[sensor]
            self.fill(scene, sensor, int(np.ravel(np.array(seed))[0]))
            return super().render(scene, sensor, seed, spp, develop, evaluate)

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            """Radiance along camera rays; `render` or `fill` must have been called before."""
            del medium
            if self._view is None:
                raise RuntimeError("irradiance_cache: call render() or fill(scene, sensor) before sample()")
            # Mitsuba's sampler does not support addresses, so it only provides a key for each lane.
            key = mi.UInt32(sampler.next_1d() * 2.0**32)
            samples = samples_of(key, dr.arange(mi.UInt32, dr.width(ray)), mi.UInt32(0))
            seen = self._view.shade(samples, mi.Ray3f(ray), self._cache)
            hit = scene.ray_test(ray, active)
            return seen.radiance + seen.direct + seen.emitted, hit, []

        def to_string(self) -> str:
            """One-line summary for logs."""
            return (
                f"IrradianceCache[bounces={self.bounces}, depth={self.depth}, quality={quality_word(self.quality)}, "
                f"records={len(self.records)}]"
            )

    mi.register_integrator("irradiance_cache", IrradianceCache)
    _registered.add(variant)

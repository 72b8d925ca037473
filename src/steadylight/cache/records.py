"""Irradiance records, the elements of the cache, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Records:
    """R irradiance records, one row each, world frame, metres, scene-linear RGB.

    A record holds K values, one for each group of lights that can be dimmed separately; the irradiance there is their
    sum. At present all lights are in one group: K = 1. All that has no K below is common to all values.

    Attributes:
        position: (R, 3) where the hemisphere was gathered.
        normal: (R, 3) unit normal of that hemisphere.
        surface: (R, 3) unit normal of the flat surface there, on the same side: on a smooth mesh, `normal` is
            interpolated and differs. The record contributes near this surface.
        irradiance: (R, K, 3) indirect irradiance E, W/m².
        translation: (R, K, 3, 3) gradient of E by position, W/m³; [r, k, c] is the gradient of channel c.
        rotation: (R, K, 3, 3) gradient of E by rotation of the normal, W/m² per radian; [r, k, c] as above, with the
            rotation vector n_record x n_query (Ward & Heckbert 1992).
        curvature: (R, K) rotational curvature, second derivative of E by rotation over -E, averaged over all rotation
            axes: 1 where all light comes from far above the horizon (E follows a cosine), 0 in uniform surroundings,
            within [-1, 1].
        radius: (R,) distance at which the record's weight has fallen to zero, metres.
        standard_error: (R, K) standard error of the mean of E's channels, as estimated from the record's own paths,
            W/m².
        headroom: (R,) free height above the record, metres; infinite if nothing is overhead. The record does not
            contribute more than half of this above or below its plane: what covers it may have points that face the
            same way (`lookup.HEADROOM`).
        barriers: (R, 2, 3) towards the two nearest walls beside the record, within its surface, 1/metres: 1 / the
            distance of the wall; zero if there is none. The record does not contribute beyond them (`lookup.BEHIND`).
        difference: (R, K, 3) half of the difference between what the two halves of the record's paths measured, W/m²:
            E + difference by the first half, E - difference by the second.
        brightest: (R, K, 2) contribution of the brightest path of each half to what the half measured, mean of E's
            channels, W/m².
        guide: (R, K, 2) two further estimates of E, mean of its channels, W/m². The first is made from the pilot
            samples and the first half, and determines the weights of what the second half measured. The second is made
            from the pilot samples and the second half, and determines those of the first half.
        guide_error: (R, K, 2) standard error of each guide, from the same paths alone, W/m².
        guide_translation: (R, K, 2, 3) gradient of each guide by position, W/m³.
        guide_rotation: (R, K, 2, 3) gradient of each guide by rotation, W/m² per radian.
    """

    position: Floats
    normal: Floats
    surface: Floats
    irradiance: Floats
    translation: Floats
    rotation: Floats
    curvature: Floats
    radius: Floats
    standard_error: Floats
    headroom: Floats
    barriers: Floats
    difference: Floats
    brightest: Floats
    guide: Floats
    guide_error: Floats
    guide_translation: Floats
    guide_rotation: Floats

    SHAPES: ClassVar[dict[str, tuple[int, ...]]] = {
        "position": (3,),
        "normal": (3,),
        "surface": (3,),
        "irradiance": (1, 3),
        "translation": (1, 3, 3),
        "rotation": (1, 3, 3),
        "curvature": (1,),
        "radius": (),
        "standard_error": (1,),
        "headroom": (),
        "barriers": (2, 3),
        "difference": (1, 3),
        "brightest": (1, 2),
        "guide": (1, 2),
        "guide_error": (1, 2),
        "guide_translation": (1, 2, 3),
        "guide_rotation": (1, 2, 3),
    }
    """Shape of one record in each array, for K = 1."""

    @classmethod
    def shapes(cls, values: int) -> dict[str, tuple[int, ...]]:
        """Shape of one record in each array, for K values."""
        return {
            name: (values, *shape[1:]) if shape[:1] == (1,) else shape for name, shape in cls.SHAPES.items()
        }

    def __post_init__(self) -> None:
        for name, shape in self.shapes(self.values).items():
            array = getattr(self, name)
            assert array.dtype == np.float32, name
            assert array.shape == (len(self), *shape), name

    def __len__(self) -> int:
        return len(self.position)

    @property
    def values(self) -> int:
        """K, number of values per record."""
        return int(self.irradiance.shape[1])

    @classmethod
    def empty(cls, values: int = 1) -> Self:
        """No records."""
        return cls(**{name: np.zeros((0, *shape), np.float32) for name, shape in cls.shapes(values).items()})

    @classmethod
    def undivided(cls, **arrays: Floats) -> Self:
        """Records whose halves are unknown: both halves and both guides are set to the whole.

        Args:
            arrays: all arrays up to `standard_error` but for `surface`, and any of the others that are known.
        """
        E, translation, rotation = (arrays[name] for name in ("irradiance", "translation", "rotation"))
        count, values, _ = E.shape

        def twice(array: Floats) -> Floats:
            return np.ascontiguousarray(np.stack([array, array], axis=2), np.float32)

        known = {
            "surface": arrays["normal"],
            "headroom": np.full(count, np.inf, np.float32),
            "barriers": np.zeros((count, 2, 3), np.float32),
            "difference": np.zeros((count, values, 3), np.float32),
            "brightest": np.zeros((count, values, 2), np.float32),
            "guide": twice(E.mean(axis=2)),
            "guide_error": twice(arrays["standard_error"]),
            "guide_translation": twice(translation.mean(axis=2)),
            "guide_rotation": twice(rotation.mean(axis=2)),
        }
        return cls(**(known | arrays))

    @classmethod
    def concatenate(cls, *parts: Records) -> Self:
        """All records of `parts`, in that order; all have the same K."""
        if not parts:
            return cls.empty()
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Records:
        """The records at `rows` (indices or a mask), in that order."""
        return Records(**{name: np.ascontiguousarray(getattr(self, name)[rows]) for name in self.SHAPES})

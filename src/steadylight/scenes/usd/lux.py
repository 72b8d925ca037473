"""Inputs that all kinds of UsdLux lights have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.usd.stage import Stage

Matrix = NDArray[np.float64]

BLENDERS_POLE: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Orientation of Blender's world without a mapping node, for which the exporter omits the rotation."""


@dataclass(frozen=True)
class Light:
    """Inputs of a light."""

    stage: Stage
    prim: Any
    to_world: Matrix

    def get(self, name: str, default: Any) -> Any:
        """An input; `default` if it is not given."""
        value = self.prim.GetAttribute(f"inputs:{name}").Get(self.stage.start)
        return default if value is None else value

    def size(self, name: str, default: float) -> float:
        """An input that is a length."""
        value = float(self.get(name, default))
        if not (math.isfinite(value) and value >= 0):
            raise SceneError(f"{name} is {value:g}; it must be finite and not negative")
        return value

    @property
    def radiance(self) -> Matrix:
        """Radiance, (3,), from intensity, exposure, colour and colour temperature, before division by the area."""
        from pxr import UsdLux

        default = 50000.0 if self.prim.GetTypeName() == "DistantLight" else 1.0
        strength = float(self.get("intensity", default)) * 2.0 ** min(float(self.get("exposure", 0.0)), 100.0)
        colour = np.array(self.get("color", (1.0, 1.0, 1.0)), dtype=np.float64)
        if self.get("enableColorTemperature", False):
            kelvin = float(np.clip(self.get("colorTemperature", 6500.0), 1000.0, 10000.0))
            # The schema requires white at 6500 K; this function deviates slightly, as do Blender's colours.
            white = np.array(UsdLux.BlackbodyTemperatureAsRgb(6500.0))
            own = self.stage.blender and self.prim.GetAttribute("inputs:colorTemperature").IsAuthored()
            colour = colour * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin)) / (1.0 if own else white)
        found = strength * colour
        if not (np.isfinite(found).all() and (found >= 0).all()):
            raise SceneError(f"emits {found.tolist()}; light must be finite and not negative")
        return np.asarray(found)

    @property
    def normalized(self) -> bool:
        """Whether the radiance is divided by the area."""
        return bool(self.get("normalize", False))

    @property
    def scale(self) -> Matrix:
        """Lengths of the axes, (3,)."""
        return np.asarray(np.linalg.norm(self.to_world[:3, :3], axis=0))

    @property
    def has_cone(self) -> bool:
        """Whether the light emits only into a cone."""
        return self.prim.HasAPI("ShapingAPI") and float(self.get("shaping:cone:angle", 90.0)) < 180.0

    def area(self, own: float) -> float:
        """Area of a flat light in the stage's units."""
        x, y = self.to_world[:3, 0], self.to_world[:3, 1]
        return own * float(np.linalg.norm(np.cross(x, y))) / self.stage.unit**2


def rotation(to_world: Matrix) -> Matrix:
    """The nearest rotation, with the origin kept."""
    u, _, v = np.linalg.svd(to_world[:3, :3])
    turned = np.eye(4)
    turned[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    turned[:3, 3] = to_world[:3, 3]
    return turned

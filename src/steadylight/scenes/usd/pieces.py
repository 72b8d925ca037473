"""Triangles of one material: what shapes and instances are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.surface import VertexColour
from steadylight.scenes.usd.materials import Painted
from steadylight.scenes.usd.meshes import Geometry

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """Triangles of one material.

    Attributes:
        name: of its entry.
        geometry: the polygons it is of.
        faces: which triangles; all if None.
        painted: its material.
        to_world: (4, 4).
    """

    name: str
    geometry: Geometry
    faces: NDArray[np.bool_] | None
    painted: Painted
    to_world: Matrix

    def entry(self, to_frame: Matrix) -> dict[str, Any] | None:
        """The mesh of a description, in a frame that `to_frame` reaches from our world."""
        made = self.geometry.entry(to_frame @ self.to_world, self.faces, self.painted.uv)
        if made is None:
            return None
        surface = self.painted.surface
        if any(isinstance(value, VertexColour) for value in vars(surface).values()):
            made.setdefault("colors", np.ones_like(made["vertices"]))
        else:
            made.pop("colors", None)
        made["bsdf"] = self.painted.finish.bsdf
        if self.painted.finish.emitter is not None:
            made["emitter"] = self.painted.finish.emitter
        return made

    def copied(self, owner: str, to_world: Matrix) -> Piece:
        """A copy at another place, of another owner."""
        return replace(self, name=f"{owner}/{self.name.rsplit('/', 1)[-1]}", to_world=to_world)

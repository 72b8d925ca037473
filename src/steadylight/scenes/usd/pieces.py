"""Triangles of one material, of which shapes and instances are made."""

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
        name: name of the entry.
        geometry: the polygons.
        faces: mask of the triangles that belong to it; all if None.
        painted: the material.
        to_world: (4, 4) from the prim's frame to our world.
    """

    name: str
    geometry: Geometry
    faces: NDArray[np.bool_] | None
    painted: Painted
    to_world: Matrix

    @property
    def triangles(self) -> int:
        """How many there are."""
        return len(self.geometry.triangles) if self.faces is None else int(np.count_nonzero(self.faces))

    def entry(self, to_frame: Matrix) -> dict[str, Any] | None:
        """The mesh as an entry of a description; `to_frame` goes from our world to the frame of the entry."""
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
        """A copy with another transform and owner."""
        return replace(self, name=f"{owner}/{self.name.rsplit('/', 1)[-1]}", to_world=to_world)

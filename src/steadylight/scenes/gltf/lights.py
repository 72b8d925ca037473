"""Lamps of a glTF scene (KHR_lights_punctual), from candela and lux to W."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.description import Note
from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.schema import Light, Spot
from steadylight.scenes.gltf.tree import Tree
from steadylight.scenes.pbr import rgb, unique
from steadylight.scenes.world import LUMENS_PER_WATT, Z_UP

Matrix = NDArray[np.float64]


def read_lights(file: File, tree: Tree) -> tuple[dict[str, Any], list[Note]]:
    """Entries of all visible lamps, and notes on them."""
    entries: dict[str, Any] = {}
    notes: list[Note] = []
    nodes = tree.visible(i for i, node in enumerate(file.document.nodes) if node.extensions.light is not None)
    lights = file.document.extensions.lights.lights
    for index in nodes:
        use = tree.node(index).extensions.light
        assert use is not None
        light = file.item("KHR_lights_punctual.lights", lights, use.light, f"nodes[{index}]")
        if light.intensity and any(light.color):
            name = unique(f"light {tree.name(index)}", entries)
            entries[name] = _emitter(light, Z_UP @ tree.world(index))
            notes += _notes(light, tree.name(index))
    if entries:
        notes.insert(0, Note("converted", "lamps", "candela and lux divided by 683 lm/W"))
    if any(index in tree.moved for index in nodes):
        notes.append(Note("left out", "animation", "motion of lamps: they stay where the file places them"))
    return entries, notes


def _emitter(light: Light, matrix: Matrix) -> dict[str, Any]:
    """A lamp as a Mitsuba emitter."""
    strength = rgb([part * light.intensity / LUMENS_PER_WATT for part in light.color])
    place = matrix[:3, 3]
    if light.type == "point":
        return {"type": "point", "position": place.tolist(), "intensity": strength}
    axis = -matrix[:3, 2]
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 0 else np.array([0.0, 0.0, -1.0])
    if light.type == "directional":
        return {"type": "directional", "direction": axis.tolist(), "irradiance": strength}
    beam, cutoff = spot_angles(light.spot)
    return {
        "type": "spot",
        "to_world": _along(axis, place),
        "intensity": strength,
        "beam_width": beam,
        "cutoff_angle": cutoff,
    }


def _along(axis: Matrix, place: Matrix) -> Matrix:
    """A frame with its z axis along `axis`."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    frame[:3, 3] = place
    return frame


def spot_angles(spot: Spot) -> tuple[float, float]:
    """Angles, in degrees, at which the light of Mitsuba's spot begins to fall off and at which it ends.

    glTF's light falls off by the square of a ramp in the cosine, Mitsuba's by a ramp in the angle. The light ends at
    the same angle, is the same on the axis, and begins to fall off where the cone has the same flux; if even a ramp
    from the axis has too much flux, it ends earlier.
    """
    inner, outer = min(spot.inner_cone_angle, spot.outer_cone_angle - 1e-4), spot.outer_cone_angle
    theta = np.linspace(0.0, outer, 4001)
    scale = math.cos(inner) - math.cos(outer)
    profile = np.clip((np.cos(theta) - math.cos(outer)) / scale, 0, 1) ** 2
    wanted = np.trapezoid(profile * np.sin(theta), theta)

    def flux(beam: float, cutoff: float) -> float:
        ramp = np.clip((cutoff - theta) / max(cutoff - beam, 1e-9), 0, 1)
        return float(np.trapezoid(ramp * np.sin(theta), theta))

    low, high = (0.0, outer - 1e-4) if flux(0.0, outer) <= wanted else (1e-3, outer)
    narrow = flux(0.0, outer) > wanted
    for _ in range(50):
        middle = (low + high) / 2
        found = flux(0.0, middle) if narrow else flux(middle, outer)
        low, high = (middle, high) if found < wanted else (low, middle)
    beam, cutoff = (0.0, high) if narrow else (low, outer)
    return math.degrees(beam), math.degrees(cutoff)


def _notes(light: Light, name: str) -> list[Note]:
    """Notes on a lamp's other properties."""
    found = []
    if light.type == "spot":
        text = "edge of its cone: a linear ramp with the same flux"
        found.append(Note("approximated", f"light {name}", text))
    if light.range is not None:
        text = "its range: light falls off with the square of the distance only"
        found.append(Note("left out", f"light {name}", text))
    return found

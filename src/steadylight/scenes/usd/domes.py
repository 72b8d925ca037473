"""Dome lights, which become the environment of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import InputError, SceneError
from steadylight.scenes.description import Note
from steadylight.scenes.image_texture import check_environment, exr_texels, linear_texels
from steadylight.scenes.pbr import rgb
from steadylight.scenes.surface import Texture
from steadylight.scenes.usd.lux import BLENDERS_POLE, Light, Matrix, rotation
from steadylight.scenes.usd.stage import Stage, label

_LEFT_TO_MITSUBA: Final = (".hdr", ".pfm")
_LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])
_Z_POLE: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass
class Domes:
    """The dome lights of a stage, which become one environment.

    Attributes:
        stage: the stage.
        notes: notes on what was changed.
    """

    stage: Stage
    notes: list[Note] = field(default_factory=list)
    _found: list[tuple[Light, Matrix | str | None]] = field(default_factory=list)

    def _note(self, kind: Any, prim: Any, text: str) -> None:
        self.notes.append(Note(kind, label(prim), text))

    def add(self, light: Light) -> None:
        """Collect a dome for `entry`."""
        asset = light.get("texture:file", None)
        where = label(light.prim)
        source = self.stage.assets.source(asset, where, named=False) if asset and asset.path else None
        form = str(light.get("texture:format", "automatic"))
        if source is not None and form not in ("automatic", "latlong"):
            self._note("left out", light.prim, f"its image, of format {form}; use latlong")
            return
        if (
            source is not None
            and self.stage.blender
            and not light.prim.GetAttribute("inputs:intensity").IsAuthored()
        ):
            text = "Blender's exporter leaves out the strength of a world with an image; 1 is assumed"
            self._note("warning", light.prim, text)
        if isinstance(source, str) and Path(source).suffix.lower() in _LEFT_TO_MITSUBA:
            check_environment(Path(source))
            self._found.append((light, self.stage.assets.named(Path(source), where)))
        else:
            self._found.append((light, None if source is None else _image(source, where)))

    def entry(self) -> tuple[str, dict[str, Any]] | None:
        """Name and entry of the environment made from all domes; None without a dome."""
        constant = np.zeros(3)
        images: list[tuple[Light, Matrix | str]] = []
        for light, image in self._found:
            if isinstance(image, np.ndarray) and not np.ptp(image, axis=(0, 1)).any():
                constant += light.radiance * image[0, 0]
            elif image is None:
                constant += light.radiance
            else:
                images.append((light, image))
        for light, _ in images[1:]:
            self._note("left out", light.prim, "a second dome with an image; a scene has one environment")
        if images:
            light, image = images[0]
            if constant.any():
                self._note(
                    "left out", light.prim, "the uniform light of another dome; a scene has one environment"
                )
            if isinstance(image, str):
                return f"light {label(light.prim)}", self._of_file(light, image)
            data = (image * light.radiance).astype(np.float32)
            return f"light {label(light.prim)}", {
                "type": "envmap",
                "data": data,
                "to_world": self._pole(light),
            }
        if constant.any():
            return f"light {label(self._found[0][0].prim)}", {
                "type": "constant",
                "radiance": rgb(constant.tolist()),
            }
        return None

    def _of_file(self, light: Light, name: str) -> dict[str, Any]:
        """The environment of a file that Mitsuba reads itself, which can be scaled but not tinted."""
        if np.ptp(light.radiance) > 1e-3 * light.radiance.max():
            self._note(
                "approximated", light.prim, "its colour: only its brightness is used; use an .exr image"
            )
        scale = float(light.radiance @ _LUMINANCE)
        return {"type": "envmap", "filename": name, "scale": scale, "to_world": self._pole(light)}

    def _pole(self, light: Light) -> Matrix:
        """Transform of a dome's image to our world."""
        from pxr import UsdGeom

        turned = rotation(light.to_world)
        turned[:3, 3] = 0
        above = light.prim.GetParent()
        own = self.stage.to_ours if above.IsPseudoRoot() else self.stage.world(above)
        z_up = str(UsdGeom.GetStageUpAxis(self.stage.stage)) == "Z"
        axis = str(light.prim.GetAttribute("poleAxis").Get() or "scene")
        if self.stage.blender and np.allclose(rotation(own), rotation(light.to_world), atol=1e-9):
            turned[:3, :3] = turned[:3, :3] @ BLENDERS_POLE
        elif light.prim.GetTypeName() == "DomeLight_1" and (axis == "Z" or (axis == "scene" and z_up)):
            turned[:3, :3] = turned[:3, :3] @ _Z_POLE
        return turned


def _image(source: NDArray[np.uint8] | str, where: str) -> Matrix:
    """The pixels of an environment map, scene-linear, (H, W, 3)."""
    try:
        high = exr_texels(source)
    except InputError as error:
        raise SceneError(f"{where}: {error}") from None
    found = linear_texels(Texture(source, srgb=True).entry()) if high is None else high
    return np.asarray(found, dtype=np.float64)

"""Radiance that a floor of albedo 0.5 reflects at the origin, for stages; run by tests in a process of its own.

Usage: python irradiance.py STAGE ... prints a JSON list of [r, g, b] / 0.5 * pi: irradiance.
"""

import json
import math
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")

from steadylight.renderers.mitsuba.scene import build_scene  # noqa: E402
from steadylight.scenes.usd.reading import describe  # noqa: E402
from steadylight.scenes.usd.request import Request  # noqa: E402


def irradiance(path: str) -> list[float]:
    scene = build_scene(describe(Request(Path(path))))
    view = mi.load_dict(
        {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0.2], [0, 0, 0], [0, 1, 0])
            @ mi.ScalarTransform4f().scale(1e-3),
            "film": {
                "type": "hdrfilm",
                "width": 1,
                "height": 1,
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter", "sample_count": 4096},
        }
    )
    image = mi.render(scene, sensor=view, integrator=mi.load_dict({"type": "path", "max_depth": 2}))
    return (np.array(image).reshape(3) / 0.5 * math.pi).tolist()


sys.stdout.write(json.dumps([irradiance(path) for path in sys.argv[1:]]) + "\n")

"""Command `scenes`."""

from __future__ import annotations

from steadylight.cli.application import app
from steadylight.display import out


@app.command()
def scenes() -> None:
    """List the bundled scenes."""
    from steadylight.scenes.bundled import BUNDLED

    width = max(map(len, BUNDLED))
    for name, scene in BUNDLED.items():
        size = f"{scene.width}x{scene.height}"
        out.print(f"{name:<{width}}  {scene.frames:>5} frames  {size:>9}  {scene.about}", soft_wrap=True)

"""The live page of a run: what the run directory says, served to a browser on this machine.

Nothing here writes to the run directory, or asks the command that works on it.
"""

from __future__ import annotations

from steadylight.live.server import LiveServer

__all__ = ["LiveServer"]

"""The live page of a run: the state of the run directory, served to a browser on this machine.

Nothing here writes to the run directory or talks to the command that works on it.
"""

from __future__ import annotations

from steadylight.live.server import LiveServer

__all__ = ["LiveServer"]

"""What is to be read: goes from our process to the one that reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Request:
    """What to read.

    Attributes:
        path: the scene file, as the user knows it.
        sensor: the camera to use, or None.
        outside: whether files outside its folder may be read.
        stage: the USD file, if it is another one: an export that will not last.
        facts: what the modelling program says of the scene beyond the export.
    """

    path: Path
    sensor: str | None = None
    outside: bool = False
    stage: Path | None = None
    facts: dict[str, Any] = field(default_factory=dict)

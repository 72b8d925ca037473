"""What to read: sent from our process to the one that reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Request:
    """What to read.

    Attributes:
        path: the scene file that the user gave.
        sensor: the camera to use, or None.
        outside: whether files outside its folder may be read.
        stage: the USD file, if it is another one: a temporary export.
        facts: facts about the scene that the export does not hold; see `exported`.
    """

    path: Path
    sensor: str | None = None
    outside: bool = False
    stage: Path | None = None
    facts: dict[str, Any] = field(default_factory=dict)

"""Where figures are from: every benchmark that renders or times prints this."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

from steadylight.animation.provenance import describe_host, package_versions


def provenance() -> dict[str, Any]:
    """Machine, versions of the packages, and commit of the checkout (empty outside one; `-dirty` if it was changed)."""
    asked = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
        check=False,
    )
    return {
        "machine": {"cpu": describe_host()["cpu"], "cores": os.cpu_count()},
        "versions": package_versions("steadylight", "mitsuba", "drjit", "numpy", "python"),
        "commit": asked.stdout.strip(),
    }

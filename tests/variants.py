"""Parameters of tests that only run with --slow."""

from __future__ import annotations

from typing import Any

import pytest


def slow(*values: Any, **more: Any) -> Any:
    """A variant that takes long, and of which a quicker one runs each time."""
    return pytest.param(*values, marks=pytest.mark.slow, **more)

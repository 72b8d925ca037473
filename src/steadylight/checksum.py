"""Checksums inside plain data (JSON), so that readers of a file detect even a single changed bit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Final

KEY: Final = "sha256"
"""Name of the entry that holds the checksum of all others."""


def with_checksum(content: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data with its checksum as a further entry."""
    return {**content, KEY: _checksum(content)}


def without_checksum(content: object, *, required: bool = True) -> dict[str, Any]:
    """Check plain data that was read, and take its checksum out.

    Args:
        content: parsed JSON.
        required: whether data without a checksum is an error; files of older versions have none.

    Raises:
        ValueError: it is not an object, or the checksum is missing or does not match; the message is a clause.
    """
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")  # noqa: TRY004 - bad data, not a bug
    rest = {name: value for name, value in content.items() if name != KEY}
    if KEY not in content:
        if required:
            raise ValueError("it has no checksum")
        return rest
    if content[KEY] != _checksum(rest):
        raise ValueError("its content does not match its checksum")
    return rest


def parse(text: str | bytes, *, required: bool = True) -> dict[str, Any]:
    """Parse a JSON object and check its checksum.

    Raises:
        ValueError: it is not JSON, or the check fails (see `without_checksum`).
    """
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    return without_checksum(content, required=required)


def _checksum(content: Mapping[str, Any]) -> str:
    # As after a round trip through JSON, which turns tuples into lists and all keys into text.
    plain = json.loads(json.dumps(content))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()

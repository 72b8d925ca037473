"""Keeps passwords out of what is printed and logged."""

from __future__ import annotations

import re

# The password ends at the last @ before the path; it may contain that sign itself.
_PASSWORD = re.compile(r"""(?<=://)([^\s/:@"']*):[^\s/"']*@""")


def redacted(text: str) -> str:
    """Text with the passwords of all URLs in it replaced by `***`: `sftp://me:***@host/run`."""
    return _PASSWORD.sub(r"\1:***@", text)

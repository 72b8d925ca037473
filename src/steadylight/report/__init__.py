"""The report of a run: one HTML page that needs nothing else.

It reads the run directory only, finished or not.
"""

from __future__ import annotations

from steadylight.report.page import write_report

__all__ = ["write_report"]

"""The report of a run: one self-contained HTML page.

It is made from the run directory alone, whether or not the run is finished.
"""

from __future__ import annotations

from steadylight.report.page import write_report

__all__ = ["write_report"]

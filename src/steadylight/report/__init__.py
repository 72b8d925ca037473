"""The report of a run: one HTML page that needs nothing else."""

from __future__ import annotations

from steadylight.report.page import write_report

__all__ = ["write_report"]

"""Pages (report, comparison, records, preview, live page) and figures for papers; each page is one HTML file.

Those about runs are made from run directories alone, whether or not the runs are finished.
"""

from __future__ import annotations

from steadylight.report.comparison import write_comparison
from steadylight.report.page import write_report

__all__ = ["write_comparison", "write_report"]

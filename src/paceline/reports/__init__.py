"""What comes out of a measurement: tables, plots, the overlay video and the page."""

from __future__ import annotations

from paceline.reports.output import OutputFolder
from paceline.reports.report import write_files, write_report

__all__ = ["OutputFolder", "write_files", "write_report"]

"""Writes results as tables, plots, an overlay video and an HTML report."""

from __future__ import annotations

from paceline.reports.common.output_folder import OutputFolder
from paceline.reports.speed.report import write_files, write_report

__all__ = ["OutputFolder", "write_files", "write_report"]

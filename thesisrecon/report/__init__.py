"""The HTML page of one run."""

from thesisrecon.report.data import HeldOut, Photograph, ReportData
from thesisrecon.report.page import write_report

__all__ = ["HeldOut", "Photograph", "ReportData", "write_report"]

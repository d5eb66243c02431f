"""The HTML page of one run."""

from thesisrecon.report.data import Photograph, ReportData
from thesisrecon.report.page import write_report

__all__ = ["Photograph", "ReportData", "write_report"]

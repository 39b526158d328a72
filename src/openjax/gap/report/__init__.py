"""The report of one case: what was found, as plain data, as text, as a page and as
files.
"""

from openjax.gap.report.report import VERDICTS, Estimate, Report
from openjax.gap.report.writing import to_fly, write_report

__all__ = ["VERDICTS", "Estimate", "Report", "to_fly", "write_report"]

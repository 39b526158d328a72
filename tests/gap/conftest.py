"""Every report that a test of the diagnosis makes keeps the rules of reports."""

from openjax.gap import diagnosis
from openjax.gap.report.rules import broken_rules

_conclude = diagnosis.conclude


def _ruled(evidence):
    report = _conclude(evidence)
    assert broken_rules(report) == []
    return report


diagnosis.conclude = _ruled

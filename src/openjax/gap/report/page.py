"""The report as one HTML file, nothing to fetch from elsewhere."""

from __future__ import annotations

from pathlib import Path

import jinja2

from openjax.gap.report import Report
from openjax.gap.report.figures import pictures

TEMPLATE = Path(__file__).with_name("page.html.jinja")
SHOWN = 5e-4  # probabilities below are left out


def page_of(report: Report) -> str:
    """The whole page as text: shares first, then words, causes, parameters, pictures, data."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATE.parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    shares = {
        **report.shares.effects,
        "sensors and clocks": report.shares.sensors,
        "unexplained": report.shares.unexplained,
    }
    ranked = sorted(report.probabilities.items(), key=lambda item: -item[1])
    return environment.get_template(TEMPLATE.name).render(
        report=report,
        shares=shares if report.effects or report.sensors else {},
        ranked=[(name, p) for name, p in ranked[:8] if p > SHOWN],
        pictures=pictures(report),
    )

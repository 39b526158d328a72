"""The report as one HTML file, nothing to fetch from elsewhere."""

import datetime
import os
import shlex
from pathlib import Path

from openjax.gap.model.library import CARDS
from openjax.gap.report.figures import figures
from openjax.gap.report.report import Report
from openjax.gap.report.response import response_of
from openjax.gap.report.trims_page import content_of
from openjax.show.pages import fill_template
from openjax.vehicle.effects import EFFECTS


def page_of(report: Report, folder: Path | None = None) -> str:
    """The whole page as text: the answer and what to type next, figures, values, and
    folded what is rarely asked. `folder`: where it is written.
    """
    ranking = sorted(report.probabilities.items(), key=lambda item: -item[1])
    return fill_template(
        "page.html.jinja",
        Path(__file__).parent,
        title=f"Diagnosis of {report.case}",
        report=report,
        does=response_of(report),
        facts=facts(report),
        shares=shares(report),
        steps=next_steps(report, folder),
        figures=figures(report),
        trims=_trims(report),
        meanings={e: EFFECTS[e].description for e in report.parameters if e in EFFECTS},
        hidden=[
            (e.replace("_", " "), CARDS[e].next_flight) for e in report.not_testable if e in CARDS
        ],
        ranked=[(name.replace("_", " "), f"{p:.3f}") for name, p in ranking[:8] if p > 5e-4],
        checks=[(q["flight"], q["issue"]) for q in report.quality],
    )


def _trims(report: Report) -> dict | None:
    """The trims that the page shows beside the reference's; None without any."""
    if report.trims is None:
        return None
    answers = report.change_by_trims is not None
    return content_of(report.trims, report.trims_in_words, answers)


def facts(report: Report) -> list[tuple[str, str]]:
    """Date, vehicle and flights."""
    entries = [("Diagnosed", datetime.datetime.now().strftime("%d %B %Y, %H:%M"))]
    evidence = report.plots.get("evidence")
    if evidence is None:
        return entries
    case = evidence.case
    mass = f"{1000 * float(case.vehicle_file.vehicle.mass):.1f} g"
    remark = ", weighed" if case.vehicle_file.mass_weighed else ""
    seconds = sum(float(flight.time[-1] - flight.time[0]) for flight in case.flights)
    return [
        *entries,
        ("Vehicle", f"{case.vehicle_file.name}, {mass}{remark}"),
        ("Flights", f"{len(case.flights)}, {seconds:.0f} s in all"),
    ]


def shares(report: Report) -> list[dict]:
    """Rows of the chart: name, value and interval in per cent, and what kind of thing
    it is.
    """
    if not report.effects and not report.sensors:
        return []

    def row(name, share, kind, note=""):
        low, high = share.interval90
        return {
            "name": name.replace("_", " "),
            "note": note,
            "kind": kind,
            "value": per_cent(share.value),
            "low": per_cent(low),
            "high": per_cent(high),
        }

    def per_cent(value):
        """Within the chart: an estimate's interval may leave it."""
        return min(max(100.0 * value, 0.0), 100.0)

    rows = [
        row(effect, share, "effect", report.shares.of_one_channel(effect))
        for effect, share in report.shares.effects.items()
    ]
    rows.append(row("sensors and clocks", report.shares.sensors, "nuisance"))
    rows.append(row("unexplained", report.shares.unexplained, "unexplained"))
    return rows


def next_steps(report: Report, folder: Path | None = None) -> list[tuple[str, str]]:
    """(why, command or empty) of what to do next: first the flight that tells
    confounded causes apart, then adapting, then training. Commands are typed in the
    page's `folder`.
    """
    steps = []
    alike = [
        f"These flights can't tell {name} from {', '.join(others)}. "
        for name, others in report.equivalent.items()
    ]
    if alike or report.next_flight:
        reason = f"{''.join(alike)}{report.next_flight} Then diagnose all of them again."
        steps.append((reason, "openjax plan . --out next_flight"))
    by_trims = report.change_by_trims
    if by_trims is not None:
        reason = f"Check whether {by_trims.causes_in_words()}, fix it, and fly again."
        steps.append((reason, ""))
    flown_with = [*report.parameters, *report.departures]
    if flown_with:
        names = ", ".join(effect.replace("_", " ") for effect in flown_with)
        tune = "openjax adapt effects.toml --policy flight"
        train = "openjax train --preset flight --effects effects.toml"
        steps.append((f"Fine-tune shipped weights to a vehicle with {names}:", tune))
        steps.append(("Or train from scratch in the corrected simulator:", train))
    if report.left_out:
        reason = (
            "Fix the logs that were left out, and diagnose again. The top of this page says "
            "what is wrong with each."
        )
        steps.append((reason, ""))
    case = _case_from(report, folder)
    if report.agrees:
        reason = "Nothing needs correcting. Keep these flights as the reference for later ones:"
        steps.append((reason, f"openjax diagnose NEW_FLIGHTS --reference {case}"))
    if "unknown" in report.effects:
        follows = f" {report.rest}" if report.rest else ""
        reason = (
            f"Look for a cause that is not on the list of effects.{follows} Has anything changed "
            "since the vehicle last flew well?"
        )
        steps.append((reason, f"openjax diagnose {case} --reference EARLIER_FLIGHTS"))
    if report.to_show:
        steps.append((f"To show {report.to_show}", ""))
    return steps


def _case_from(report: Report, folder: Path | None) -> str:
    """The case's folder as it is typed in the page's folder."""
    evidence = report.plots.get("evidence")
    path = None if evidence is None else evidence.case.path
    if path is None or folder is None:
        return shlex.quote(report.case)
    return shlex.quote(os.path.relpath(path.resolve(), folder.resolve()))

"""Rules that every report must keep, whatever flew: its parts don't contradict each other."""

import re
from collections.abc import Iterator

import numpy as np

from openjax.gap.decision import DECISION
from openjax.gap.identification.estimates import TORQUES
from openjax.gap.identification.quantities import TALKED_OF
from openjax.gap.report.report import VERDICTS, VERDICTS_SINCE, Report
from openjax.vehicle.effects import EFFECTS

ROUNDING = 1e-9
AGREE = (VERDICTS["none"], VERDICTS_SINCE["none"])
CHANGED = "The vehicle changed"
NO_CHANGE = "No change"


def broken_rules(report: Report) -> list[str]:
    """The rules that a report breaks, one line each; none of a good one."""
    checks = (_testable, _shares, _predictions, _domains, _likelihood)
    checks += (_one_verdict, _measurements, _values, _percentages)
    return [f"{report.case}: {words}" for check in checks for words in check(report)]


def _testable(report: Report) -> Iterator[str]:
    """A named effect is testable."""
    for effect in report.named:
        if effect in report.not_testable:
            yield f"{effect} is named and not testable"


def _by_torques(report: Report) -> set[str]:
    """Effects that the torques name, whatever short predictions show of them: torques that are
    trusted, or that changed since the reference.
    """
    does = report.identification
    if does is None:
        return set()
    return set(TORQUES) if does.trustworthy or report.reference else set()


def _shares(report: Report) -> Iterator[str]:
    """A named effect has a share of the gap, unless the torques told it."""
    for effect in report.named:
        share = report.shares.effects[effect]
        low, high = share.interval90
        if min(high, share.value) < DECISION.least_share and effect not in _by_torques(report):
            yield f"{effect} is named with a share of {share.value:.3f} [{low:.3f}, {high:.3f}]"
        if not low - ROUNDING <= share.value <= high + ROUNDING:
            yield f"{effect} has a share of {share.value:.3f} outside of [{low:.3f}, {high:.3f}]"


def _predictions(report: Report) -> Iterator[str]:
    """Named effects make held-out predictions no worse."""
    if set(report.named) - _by_torques(report) and report.gap.reduction < 0.0:
        yield f"{', '.join(report.named)}: held-out predictions get worse"


def _domains(report: Report) -> Iterator[str]:
    """Values and intervals lie where their parameters mean anything."""
    evidence = report.plots.get("evidence")
    vehicle = None if evidence is None else evidence.vehicles[0]
    for effect, estimates in report.parameters.items():
        for name, estimate in estimates.items() if effect in EFFECTS else ():
            low, high = EFFECTS[effect].parameters[name].limits(vehicle)
            start, end = estimate.interval90
            if not low <= start <= estimate.value <= end <= high:
                yield (
                    f"{effect}.{name} = {estimate.value:.4g} [{start:.4g}, {end:.4g}] leaves "
                    f"[{low:.4g}, {high:.4g}]"
                )


def _likelihood(report: Report) -> Iterator[str]:
    """Nothing is likelier than what is named, and "none" isn't likely beside a sure
    share.
    """
    chance = report.probabilities
    answers = report.effects or ("none",)
    likelihood = max(chance.get(name, 0.0) for name in answers)
    second = report.runner_up.partition(" (")[0]
    if second and chance.get(second, 0.0) > likelihood + ROUNDING:
        yield f"the runner-up {second} ({chance[second]:.2f}) is likelier than {', '.join(answers)}"
    sure = max((report.shares.effects[e].interval90[0] for e in report.named), default=0.0)
    is_sure = sure > DECISION.most_of_gap
    if is_sure and chance.get("none", 0.0) > DECISION.none_beside + ROUNDING:
        yield f"none ({chance['none']:.2f}) beside a share of at least {sure:.2f}"


def _one_verdict(report: Report) -> Iterator[str]:
    """One sentence says what was found, and none below says otherwise."""
    lines = report.in_words()
    text = " ".join(lines)
    headline = report.headline()
    if sum(line.startswith(headline) for line in lines) != 1:
        yield "the verdict isn't said once"
    for name in report.named:
        if name.replace("_", " ") not in headline:
            yield f"{name} is named, and the first sentence doesn't say so"
    agrees = any(words in text for words in AGREE)
    differs = [*report.named, *report.departures]
    if agrees and (differs or "unknown" in report.effects):
        yield f"all agrees, and {', '.join(differs) or 'something'} differs"
    if agrees and report.gap.before > report.gap.floor * (1.0 + DECISION.loud_gap):
        yield f"all agrees, and the gap is {report.gap.before:.2f}"
    says_no_change = NO_CHANGE in text or VERDICTS_SINCE["none"] in text
    if says_no_change and (CHANGED in text or (report.named and report.reference)):
        yield "one line says changed, another says no change"


def _measurements(report: Report) -> Iterator[str]:
    """The words on the response are those of the measurement."""
    does = report.identification
    if does is None or not does.trustworthy:
        return
    text = " ".join(report.in_words())
    ratio, _ = does.at(TALKED_OF)
    error, _ = does.errors_at(TALKED_OF)
    if "as the simulator does" in text and abs(np.log(ratio)) > max(error, DECISION.form_error):
        yield f"it turns as the simulator does, by {ratio:.2f} with an error of {error:.2f}"
    for effect in {q.effect for q in does.quantities.values() if q.departs}:
        is_in_text = does.in_words(effect) in text
        if (
            not is_in_text
            and not report.reference
            and effect in (*report.named, *report.departures)
        ):
            yield f"{effect} was measured to differ, and no line says so"


def _values(report: Report) -> Iterator[str]:
    """A value that is printed is a size, and called unusual only where all of its
    interval is.
    """
    for line in report.in_words():
        for value, low, high in re.findall(r"= (\S+) \[(\S+), (\S+)\]", line):
            start = float(low)
            end = float(high)
            if start == end:
                yield f"an interval has no width: {value} [{low}, {high}]"
            near, far = sorted((abs(start), abs(end)))
            if start * end > 0.0 and far > DECISION.size_ratio * near * (1.0 + 1e-3):
                yield f"an interval is no size: {value} [{low}, {high}]"
    for effect, estimates in report.parameters.items():
        for name, estimate in estimates.items():
            low, high = estimate.interval90
            overlaps = low <= estimate.usual[1] and high >= estimate.usual[0]
            if "(unusual)" in estimate.in_words(name) and overlaps:
                yield f"{effect}.{name} is called unusual, and may be usual"


def _percentages(report: Report) -> Iterator[str]:
    """Percentages of the first sentence are the shares."""
    for name in report.named:
        value = report.shares.effects[name].value
        words = f"{report.class_of(name).replace('_', ' ')} ({100 * value:.0f} %)"
        if words not in report.headline():
            yield f"{name} has a share of {value:.2f}, and the first sentence another"

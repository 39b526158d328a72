"""What every report must keep, whatever flew: its parts don't contradict each other."""

from collections.abc import Iterator

from openjax.gap.report.report import Report
from openjax.vehicle.effects import EFFECTS

LEAST_SHARE = 0.005  # of the gap: less is shown as nothing
SURE_SHARE = 0.5  # lower end of a share's interval from which something acts
NOTHING = 0.2  # largest probability of "none" beside such a share
ROUNDING = 1e-9


def broken_rules(report: Report) -> list[str]:
    """The rules that a report breaks, one line each; none of a good one."""
    checks = (_testable, _shares, _predictions, _domains, _likelihood)
    return [f"{report.case}: {words}" for check in checks for words in check(report)]


def _testable(report: Report) -> Iterator[str]:
    """What is named is testable."""
    for effect in report.named:
        if effect in report.not_testable:
            yield f"{effect} is named and not testable"


def _shares(report: Report) -> Iterator[str]:
    """What is named has a share."""
    for effect in report.named:
        share = report.shares.effects[effect]
        low, high = share.interval90
        if high < LEAST_SHARE:
            yield f"{effect} is named with a share of {share.value:.3f} [{low:.3f}, {high:.3f}]"
        if not low - ROUNDING <= share.value <= high + ROUNDING:
            yield f"{effect} has a share of {share.value:.3f} outside of [{low:.3f}, {high:.3f}]"


def _predictions(report: Report) -> Iterator[str]:
    """What is named makes held-out predictions no worse."""
    if report.named and report.gap.reduction < 0.0:
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
    if sure > SURE_SHARE and chance.get("none", 0.0) > NOTHING + ROUNDING:
        yield f"none ({chance['none']:.2f}) beside a share of at least {sure:.2f}"

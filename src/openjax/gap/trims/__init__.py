"""Trims and gains of two sets of flights of one vehicle, compared with each other instead
of with the simulator, so that what model and sensors share cancels. Motor commands alone
are enough, and every further day sharpens what days differ by. So this stays beside the
diagnosis, which can't be made of motors alone, takes a day's trims for its own, and asks
for quick turns before it judges gains.

`figures` reads what each flight says about its vehicle; `days` takes a day as a random
effect; `causes` says what each cause would do, `weigh` how well each explains what
differs; `change` is what comes out.
"""

from collections.abc import Sequence

import numpy as np

from openjax.errors import TooLittle, UserError
from openjax.flights.case import LogFolder
from openjax.flights.flight import Case, Issue
from openjax.gap.decision import DECISION
from openjax.gap.trims.causes import ROTOR_PLACES, SIDES, hypotheses_of
from openjax.gap.trims.change import Change, Interval
from openjax.gap.trims.days import (
    battery_of,
    by_day,
    days_told_apart,
    error_of,
    spread_of_charge,
    spread_of_days,
)
from openjax.gap.trims.figures import FIGURES, TRIMS, FlightFigures, figures_of, mixer_of
from openjax.gap.trims.weigh import least_shown, weigh


def compare(flights: LogFolder, references: Sequence[LogFolder]) -> Change:
    """Find what changed in the flights of a folder against those of one or more reference
    folders (days).

    Raises UserError for flights of several vehicles, and of that TooLittle for a folder
    without a usable flight.
    """
    new_case, new, quality = read(flights)
    old: list[FlightFigures] = []
    for folder in references:
        case, figures, issues = read(folder)
        if {f.vehicle for f in case.flights} != {f.vehicle for f in new_case.flights}:
            raise UserError(f"{folder.path}: holds flights of another vehicle than {flights.path}")
        old += figures
        quality += issues
    return change_between(new_case.name, new, old, new_case, tuple(quality))


def read(folder: LogFolder) -> tuple[Case, list[FlightFigures], list[Issue]]:
    """A folder's case, the figures of its flights by day, and what was left out. Raises
    UserError as `compare`.
    """
    case = folder.case(comparison=True)
    if len({f.vehicle for f in case.flights}) > 1:
        raise UserError(
            f"{folder.path}: holds several vehicles; a comparison is of one vehicle with itself"
        )
    quality = list(case.quality)
    figures = []
    for flight in case.flights:
        values = figures_of(flight, case, str(folder.path))
        if isinstance(values, str):
            quality.append(Issue(flight.name, values, refused=True, kind="comparison"))
        else:
            figures.append(values)
    if not figures:
        reasons = "; ".join(dict.fromkeys(i.issue for i in quality if i.refused))
        raise TooLittle(f"{folder.path}: no flight can be compared: {reasons}")
    return case, days_told_apart(figures), quality


def change_between(
    name: str,
    new: Sequence[FlightFigures],
    old: Sequence[FlightFigures],
    case: Case,
    quality: tuple[Issue, ...] = (),
) -> Change:
    """`compare` for figures that are there already; `case` gives the vehicle's geometry
    and motor order.
    """
    mixer = mixer_of(case.vehicle_of(case.flights[0]))
    battery = battery_of([*new, *old])
    old_days = by_day(old, battery)
    new_days = by_day(new, battery)
    difference = new_days.mean - old_days.mean
    spread, freedom = spread_of_days(old_days, new_days)
    charge = spread_of_charge([*new, *old])
    scale = error_of(old_days, new_days, spread, charge)
    trims = old_days.mean[: len(TRIMS)]
    hypotheses = hypotheses_of(mixer, trims)
    evidence = weigh(hypotheses, difference, scale, freedom)
    place, within = evidence.place()
    order = case.vehicle_file.motor_permutation

    def as_logged(rotors) -> tuple[int, ...]:
        return tuple(sorted(order[j] + 1 for j in rotors))

    return Change(
        name=name,
        changed=evidence.probability > DECISION.least_probability,
        probability=evidence.probability,
        rotors=as_logged(place),
        side=ROTOR_PLACES[place[0]] if len(place) == 1 else SIDES.get(place, ""),
        causes=evidence.causes,
        causes_here=evidence.causes_at(within),
        places={as_logged(p): share for p, share in evidence.places.items()},
        size=evidence.size(within),
        figures=_intervals(difference, 1.645 * scale),
        least=least_shown(hypotheses, mixer, trims, scale, freedom),
        reference=tuple(old),
        flights=tuple(new),
        quality=quality,
        spread=dict(zip(FIGURES, spread.tolist(), strict=True)),
    )


def _intervals(difference: np.ndarray, reach: np.ndarray) -> dict[str, Interval]:
    """The differences (F,) that the logs give, each so far up and down."""
    return {
        n: Interval(float(d), float(d - r), float(d + r))
        for n, d, r in zip(FIGURES, difference, reach, strict=True)
        if np.isfinite(d)
    }


__all__ = ["Change", "Interval", "change_between", "compare", "read"]

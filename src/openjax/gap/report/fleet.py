"""Several vehicles in one report: what each one's answer is, and in which numbers one
differs from the others.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from openjax.gap.decision import DECISION
from openjax.gap.identification.quantities import REACH, Quantity, words_of
from openjax.gap.report.report import Report
from openjax.gap.trims.change import Change
from openjax.show.pages import fill_template


@dataclass(frozen=True)
class Member:
    """A vehicle's answer, and the numbers that are held beside the others'."""

    name: str
    title: str
    answer: str
    gap: tuple[float, float] | None
    """Before and after; None of trims alone."""
    numbers: dict[str, Quantity]


@dataclass(frozen=True)
class Difference:
    """A number in which one vehicle differs from the others."""

    vehicle: str
    number: str
    value: Quantity
    others: float
    """The median of all; of two vehicles, the other's."""

    def in_words(self) -> str:
        """The number, and the others'."""
        others = self.value.beside(self.others)
        return f"{words_of(self.number)} {self.value.as_text()} against {others}"


def member_of(name: str, answer: Report | Change) -> Member:
    """The part of a vehicle's answer that the page compares."""
    if isinstance(answer, Change):
        return Member(name, answer.title, answer.sentence(), None, {})
    gap = (answer.gap.before, answer.gap.after)
    return Member(name, answer.title, answer.headline(), gap, answer.numbers)


def differences(members: Sequence[Member]) -> list[Difference]:
    """Numbers of a vehicle that are further from the median than their errors and the errors of
    form. Of two vehicles, each is compared with the other.
    """
    out = []
    for number in dict.fromkeys(n for member in members for n in member.numbers):
        each = {m.name: m.numbers[number] for m in members if number in m.numbers}
        for vehicle, quantity in each.items():
            # one among many can't move a median; of two it would be half of it
            others = [q for name, q in each.items() if name != vehicle or len(each) > 2]
            middle = float(np.median([q.value for q in others])) if others else quantity.value
            error = float(np.median([_error(q) for q in others])) if others else 0.0
            if _differs(quantity, middle, error):
                out.append(Difference(vehicle, number, quantity, middle))
    return out


def _differs(quantity: Quantity, middle: float, error: float) -> bool:
    """True if a number differs from another one that has an error."""
    apart = abs(quantity.value - middle)
    errors = DECISION.standard_errors * float(np.hypot(_error(quantity), error))
    return apart > max(errors, DECISION.form_error * max(abs(quantity.value), abs(middle)))


def _error(quantity: Quantity) -> float:
    """Standard deviation, from the 90 % interval."""
    low, high = quantity.interval90
    return (high - low) / (2.0 * REACH)


def fleet_in_words(members: Sequence[Member]) -> list[str]:
    """A line for each vehicle that differs from the others; one where none does."""
    by_vehicle: dict[str, list[str]] = {}
    for difference in differences(members):
        by_vehicle.setdefault(difference.vehicle, []).append(difference.in_words())
    if not by_vehicle:
        return [f"No number of the {len(members)} vehicles differs by more than its errors."]
    if len(members) == 2:  # each differs from the other
        name, numbers = next(iter(by_vehicle.items()))
        other = next(m.name for m in members if m.name != name)
        return [f"{name} and {other} differ, in this order: {'; '.join(numbers)}."]
    return [f"{name} differs from the others: {'; '.join(n)}." for name, n in by_vehicle.items()]


def fleet_to_dict(members: Sequence[Member]) -> dict:
    """`vehicles.json`."""
    return {
        "vehicles": {m.name: asdict(m) for m in members},
        "differences": [asdict(d) | {"in_words": d.in_words()} for d in differences(members)],
    }


def page_of_fleet(members: Sequence[Member]) -> str:
    """`vehicles.html`: nothing to fetch from elsewhere but each vehicle's own page."""
    marks = {(d.number, d.vehicle) for d in differences(members)}
    names = dict.fromkeys(n for member in members for n in member.numbers)
    rows = []
    for number in names:
        cells = [_cell(number, member, marks) for member in members]
        some = next(m.numbers[number] for m in members if number in m.numbers)
        rows.append((words_of(number), cells, some.beside(some.simulator)))
    # rows in which some vehicle differs come first
    rows.sort(key=lambda row: not any(cell["differs"] for cell in row[1]))
    return fill_template(
        "fleet.html.jinja",
        Path(__file__).parent,
        title=f"{len(members)} vehicles side by side",
        lines=fleet_in_words(members),
        members=members,
        rows=rows,
    )


def _cell(number: str, member: Member, marks: set[tuple[str, str]]) -> dict:
    """A vehicle's number in the table."""
    quantity = member.numbers.get(number)
    return {
        "vehicle": member.name,
        "text": "not measured" if quantity is None else quantity.as_text(),
        "differs": (number, member.name) in marks,
    }

"""Differences between the trims of two sets of flights, as plain data and in words."""

from dataclasses import dataclass

import numpy as np

from openjax.flights.flight import Issue
from openjax.gap.trims.causes import CAUSES
from openjax.gap.trims.figures import FIGURES, TRIMS, FlightFigures


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Change:
    """Differences between two sets of flights.

    `probability` that the vehicle changed. `places` {rotors: p} and `causes` {cause: p}
    say how probable each is if it did (`causes_here`: at the most probable place);
    rotors count 1 to 4 as logged (m1..m4). `size` is the thrust that was lost, as a
    share of one rotor's, at the most probable place (for a weight: its share of a
    rotor's load); `figures` are the differences, their intervals with the spread of a
    day in them; `least` is the loss of a single rotor that these flights would have
    shown. `alone_because`: why there is no diagnosis beside it; empty where there is.
    """

    name: str
    changed: bool
    probability: float
    rotors: tuple[int, ...]
    side: str
    causes: dict[str, float]
    causes_here: dict[str, float]
    places: dict[tuple[int, ...], float]
    size: Interval
    figures: dict[str, Interval]
    least: float
    reference: tuple[FlightFigures, ...]
    flights: tuple[FlightFigures, ...]
    quality: tuple[Issue, ...]
    spread: dict[str, float]  # of normal days, as estimated
    alone_because: str = ""

    @property
    def charge_unknown(self) -> bool:
        """True if a battery's charge may differ unseen: duty cycles without a
        voltage.
        """
        return any(f.duty and f.voltage is None for f in (*self.reference, *self.flights))

    @property
    def days(self) -> int:
        """Days that the reference holds."""
        return len({f.day for f in self.reference})

    @property
    def likely_causes(self) -> tuple[str, ...]:
        """The most probable cause at the most probable place, and those that these
        flights can't split from it.
        """
        top = max(self.causes_here.values())
        causes = [c for c, p in self.causes_here.items() if p > 0.25 * top]
        return tuple(sorted(causes, key=lambda c: -self.causes_here[c]))

    @property
    def trims_changed(self) -> bool:
        """True if the most probable cause moves the trims."""
        return self.changed and not CAUSES[self.likely_causes[0]].figures

    @property
    def trims_differ(self) -> bool:
        """True if a trim differs by more than days do, whatever the cause."""
        return any(
            not self.figures[name].low <= 0.0 <= self.figures[name].high
            for name in TRIMS
            if name in self.figures
        )

    @property
    def effects(self) -> tuple[str, ...]:
        """Changes by the names of the effect library, the most probable first."""
        if not self.changed:
            return ()
        effects = (e for c in self.likely_causes for e in CAUSES[c].effects)
        return tuple(dict.fromkeys(effects))

    @property
    def title(self) -> str:
        """The answer in a word."""
        return "changed" if self.changed else "no change"

    @property
    def left_out(self) -> list[str]:
        """Logs that weren't used, each with the reason."""
        return [f"{i.flight}: {i.issue}" for i in self.quality if i.refused]

    @property
    def notes(self) -> list[str]:
        """Findings in the logs that were used."""
        return [f"{i.flight}: {i.issue}" for i in self.quality if not i.refused]

    def in_words(self) -> list[str]:
        """The answer in a few plain sentences."""
        lines = [self.sentence(), *self.measured_in_words()]
        if not self.changed and self.probability > 0.2:
            lines.append(f"Below the spread of days; if anything, {self._sentences()[0]}.")
        if self.alone_because:
            lines.append(
                f"Trims alone were compared, as a diagnosis needs more: {self.alone_because}."
            )
        return lines

    def measured_in_words(self) -> list[str]:
        """The size of the change, and the differences behind it."""
        lines = []
        if self.trims_changed:
            value, low, high = (100 * v for v in (self.size.value, self.size.low, self.size.high))
            end = " lost." if value > 0 else " (negative: it got stronger or lighter)."
            lines.append(f"Size: {value:.0f} % [{low:.0f}, {high:.0f}] of a rotor's thrust{end}")
            if len(self._sentences()) > 1:
                lines.append(
                    "These flights can't split the causes named; a weighed vehicle or another "
                    "propeller would."
                )
        elif self.changed:
            causes = (CAUSES[c].figures for c in self.likely_causes)
            names = dict.fromkeys(n for figures in causes for n in figures)
            lines += [
                f"{FIGURES[n].words.capitalize()}: {difference_in_words(n, self.figures[n])}."
                for n in names
                if n in self.figures
            ]
        return lines + self.differences_in_words()

    def sentence(self) -> str:
        """The change and its cause, if there is one."""
        chance = f"{self.probability:.2f}"
        if not self.changed:
            return (
                "No change beyond what days of such vehicles differ by (probability of one: "
                f"{chance})."
            )
        return f"The vehicle changed (probability {chance}): {self.causes_in_words()}."

    def causes_in_words(self) -> str:
        """The causes that these flights can't tell apart."""
        return " or ".join(self._sentences())

    def _sentences(self) -> list[str]:
        """The likely causes in words, each once."""
        return list(dict.fromkeys(_cause_in_words(self, cause) for cause in self.likely_causes))

    def differences_in_words(self) -> list[str]:
        """By what trims differ, and what that is compared with: no verdict."""
        differences = ", ".join(
            f"{n} {100 * v.value:+z.1f} % [{100 * v.low:+z.1f}, {100 * v.high:+z.1f}]"
            for n, v in self.figures.items()
            if n in TRIMS
        )
        days = f"{self.days} day{'s' * (self.days > 1)}"
        spread = (
            "estimated from them and a prior"
            if self.days > 1
            else "a prior: fly the reference on several days"
        )
        battery = (
            "What may differ is the battery: an emptier one makes less thrust of a duty cycle. "
            "Log vbat, and thrust can be compared."
        )
        return [
            *([battery] if self.charge_unknown else []),
            "Trims against the reference, as shares of hover, with the spread of days: "
            f"{differences}.",
            f"The reference holds {len(self.reference)} flights of {days} (their spread is "
            f"{spread}). A single rotor that lost less than {100 * self.least:.0f} % of its thrust "
            "would not show.",
        ]

    def prediction(self) -> dict:
        """The case's entry in a predictions file: `probabilities` of no change and of
        each cause add up to one.
        """
        causes = {
            c.replace(" ", "_"): round(self.probability * p, 5) for c, p in self.causes.items()
        }
        return {
            "changed": self.changed,
            "effects": list(self.effects),
            "rotors": list(self.rotors) if self.trims_changed else [],
            "side": self.side if self.trims_changed else "",
            "size": round(self.size.value, 4),
            "probabilities": {"no_change": round(1.0 - self.probability, 5)} | causes,
        }

    def to_dict(self) -> dict:
        """The `trims` of a `report.json`, or the whole of it where there are no
        others.
        """
        return self.prediction() | {
            "in_words": self.in_words(),
            "least_shown": round(self.least, 4),
            "size90": [round(self.size.low, 4), round(self.size.high, 4)],
            "places": {
                "+".join(map(str, p)) or "unclear": round(v, 4)
                for p, v in self.places.items()
                if v > 5e-4
            },
            "figures": {
                n: {"value": round(v.value, 5), "interval90": [round(v.low, 5), round(v.high, 5)]}
                for n, v in self.figures.items()
            },
            "days": {
                "reference": self.days,
                "spread": {n: round(v, 4) for n, v in self.spread.items()},
            },
            "flights": [
                *(_row("reference", f) for f in self.reference),
                *(_row("new", f) for f in self.flights),
            ],
            "quality": [{"flight": i.flight, "issue": i.issue} for i in self.quality],
        }


def _row(which: str, flight: FlightFigures) -> dict:
    """A flight of one of the sets, as plain data."""
    day = flight.day.rpartition("/")[2]
    row = {"flight": flight.name, "set": which, "day": day, "voltage": flight.voltage}
    return row | {n: round(v[0], 5) for n, v in flight.values.items()}


def _cause_in_words(change: Change, cause: str) -> str:
    rotors = " and ".join(str(r) for r in change.rotors)
    more = change.size.value > 0
    weaker = "weaker" if more else "stronger"
    several = len(change.rotors) > 1
    if cause == "one rotor weaker" and several:
        return f"one of rotors {rotors} ({change.side}) is {weaker}"
    if cause.endswith("weaker"):
        return (
            f"rotor{'s' * several} {rotors} ({change.side}) {'are' if several else 'is'} {weaker}"
        )
    if cause == "weight":
        beside = f" at the {change.side}" if change.side and change.side != "diagonal" else ""
        return f"a weight was {'added' if more else 'taken off'}{beside}"
    if cause == "whole vehicle":
        return (
            "the whole vehicle is heavier or its thrust weaker"
            if more
            else "it is lighter or stronger"
        )
    what = CAUSES[cause].what
    return f"the {what} changed" if what else "something without a known pattern"


def difference_in_words(name: str, d: Interval) -> str:
    """The difference of a figure: "+12 % [+8, +16]"; see `Figure`."""
    unit = FIGURES[name].unit
    factor = FIGURES[name].factor
    value, low, high = (
        factor * v if factor else 100 * np.expm1(v) for v in (d.value, d.low, d.high)
    )
    return f"{value:+.3g} {unit} [{low:+.3g}, {high:+.3g}]"

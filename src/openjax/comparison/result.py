"""What a comparison says, as plain data."""

from dataclasses import dataclass

from openjax.comparison.causes import CAUSES
from openjax.comparison.figures import FlightFigures
from openjax.flights.flight import Issue

SHOWN = 0.5  # probability from which on something is said to have changed


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Change:
    """What differs between two sets of flights.

    `probability` that the vehicle changed. `places` {rotors: p} and `causes` {cause: p}
    say how probable each is if it did (`causes_here`: at the most probable place);
    rotors count 1 to 4 as logged (m1..m4). `trims_changed`: the most probable cause
    moves the trims. `size` is the thrust that was lost, as a share of one rotor's, at
    the most probable place (for a weight: its share of a rotor's load); `figures` are
    the differences, their intervals with the spread of a day in them; `least` is the
    loss of a single rotor that these flights would have shown.
    """

    name: str
    changed: bool
    probability: float
    trims_changed: bool
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

    @property
    def charge_unknown(self) -> bool:
        """Whether a battery's charge may differ unseen: duty cycles without a
        voltage.
        """
        return any(
            f.duty and f.voltage is None for f in (*self.reference, *self.flights)
        )

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
        likely = [c for c, p in self.causes_here.items() if p > 0.25 * top]
        return tuple(sorted(likely, key=lambda c: -self.causes_here[c]))

    @property
    def effects(self) -> tuple[str, ...]:
        """What changed by the names of the effect library, the most probable first."""
        if not self.changed:
            return ()
        return tuple(
            dict.fromkeys(
                effect
                for cause in self.likely_causes
                for effect in CAUSES[cause].effects
            )
        )

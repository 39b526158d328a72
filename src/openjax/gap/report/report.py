"""What was found in one case, as plain data and as text."""

from dataclasses import asdict, dataclass, field, fields, is_dataclass

from openjax.gap.identification.quantities import Identification
from openjax.gap.shares import Gap, Split
from openjax.gap.trims.change import Change
from openjax.gap.where import Place, in_words

VERDICTS = {
    "none": "The simulator agrees with these flights to within the sensors' noise.",
    "unknown": "The simulator misses something that no known effect explains.",
    "not_testable": (
        "No effect is seen, but these flights couldn't show most of those that are usual."
    ),
}
"""What is said of each verdict that names nothing."""
VERDICTS_SINCE = {
    "none": "The vehicle is as in its reference flights, to within what a day changes.",
    "unknown": "The vehicle changed in a way that no known effect explains.",
    "not_testable": (
        "No change is seen, but these flights couldn't show most of those that are usual."
    ),
}
"""The same where a reference of the vehicle was given."""


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter with its 90 % interval."""

    value: float
    unit: str
    interval90: tuple[float, float]
    usual: tuple[float, float]
    """Its prior range."""
    may_be_none: bool = False
    """Whether the interval holds the value at which the effect does nothing."""

    def in_words(self, name: str) -> str:
        """The value of the parameter `name` with its interval and unit, and whether it
        is unusual.
        """
        low, high = self.interval90
        text = f"{name} = {self.value:.4g} [{low:.4g}, {high:.4g}]"
        if self.unit != "1":
            text += f" {self.unit}"
        return f"{text} (unusual)" if self.unusual else text

    @property
    def unusual(self) -> bool:
        """Whether it lies outside of its prior range."""
        return not self.usual[0] <= self.value <= self.usual[1]


@dataclass(frozen=True, eq=False)
class Report:
    """What the flights of one case say."""

    case: str
    verdict: str
    """One of `VERDICTS`, or "effect"."""
    effects: tuple[str, ...]
    """By share, largest first; "unknown" stands among them where what is left isn't
    noise.
    """
    probabilities: dict[str, float]
    shares: Split
    equivalent: dict[str, list[str]]
    """{named effect: those that would do as well in its place}."""
    parameters: dict[str, dict[str, Estimate]]
    """{effect: {parameter: estimate}} of the named effects."""
    where: list[Place]
    gap: Gap
    not_testable: list[str]
    quality: list[dict]
    """An entry for each flight; with `left_out` where it wasn't used."""
    next_flight: str = ""
    """The segment that tells most, in words; empty where little is left open."""
    to_show: str = ""
    """What to fly and log for an effect that no segment shows."""
    vehicle: str = ""
    """The vehicle file of the flights."""
    runner_up: str = ""
    rest: str = ""
    """What is left when the named effects are accounted for."""
    sensors: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    nuisances: dict[str, str] = field(default_factory=dict)
    """{name: what it took}."""
    residual: dict[str, float] = field(default_factory=dict)
    residual_before: dict[str, float] = field(default_factory=dict)
    """What the reference leaves of the same measures."""
    reference: str = ""
    """What the reference flights say of the vehicle; empty: none were given."""
    trims: Change | None = None
    """What trims say of a change since the reference; None: there is none, or its logs
    show none.
    """
    identification: Identification | None = None
    """What the vehicle does; None: no motors were logged."""
    seconds: float = 0.0
    plots: dict = field(default_factory=dict, repr=False)
    """Arrays for the pictures; no part of the JSON."""

    @property
    def named(self) -> list[str]:
        """The effects without "unknown"."""
        return [e for e in self.effects if e != "unknown"]

    @property
    def untested_change(self) -> Change | None:
        """What trims and gains say changed, where nothing is named and these flights
        couldn't have shown it to the diagnosis; else None.
        """
        trims = self.trims
        if trims is None or self.effects or not trims.effects:
            return None
        return trims if set(trims.effects) <= set(self.not_testable) else None

    @property
    def title(self) -> str:
        """The answer in a word."""
        if self.untested_change is not None:
            return ", ".join(self.untested_change.effects)
        if self.effects or not self.reference:
            return ", ".join(self.effects) or self.verdict
        return "no change"

    @property
    def left_out(self) -> list[str]:
        """Logs that weren't used, those of one reason together."""
        logs: dict[str, list[str]] = {}
        for q in self.quality:
            if q.get("left_out"):
                logs.setdefault(q["issue"], []).append(q["flight"])
        return [f"{', '.join(names)}: {issue}" for issue, names in logs.items()]

    @property
    def notes(self) -> list[str]:
        """What was found in the logs that were used."""
        return [f"{q['flight']}: {q['issue']}" for q in self.quality if not q.get("left_out")]

    def prediction(self) -> dict:
        """The case's entry in a predictions file."""
        return {
            "effects": list(self.effects),
            "probabilities": {k: round(v, 5) for k, v in self.probabilities.items() if v >= 5e-6},
            "where": in_words(self.where),
            "reduction": round(min(max(self.gap.reduction, 0.0), 1.0), 4),
            "not_testable": list(self.not_testable),
        }

    def to_dict(self) -> dict:
        """`report.json`: every field but the pictures' arrays, numbers rounded."""
        shares = {
            "effects": self.shares.effects,
            "sensors": self.shares.sensors,
            "unexplained": self.shares.unexplained,
        }
        estimates = {
            effect: {name: asdict(v) | {"unusual": v.unusual} for name, v in values.items()}
            for effect, values in self.parameters.items()
        }
        apart = ("case", "plots", "seconds", "identification", "trims")
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in apart}
        if self.identification is not None:
            of_gap = {e: share.value for e, share in self.shares.effects.items()}
            plain["identification"] = self.identification.to_dict(of_gap)
        if self.trims is not None:
            plain["trims"] = self.trims.to_dict()
        return _plain(plain | {"shares": shares, "parameters": estimates})

    def class_of(self, effect: str) -> str:
        """A named effect, and those that would do as well in its place."""
        return " or ".join([effect, *self.equivalent.get(effect, ())])

    def shares_in_words(self) -> str:
        """Every named class' share with its interval, then sensors and clocks, then
        what is unexplained.
        """
        class_shares = []
        for effect in self.named:
            share = self.shares.effects[effect]
            low, high = share.interval90
            interval = f"[{_short(low)}, {_short(high)}]"
            class_shares.append(f"{self.class_of(effect)} {_short(share.value)} {interval}")
        parts = [
            *([", ".join(class_shares)] if class_shares else []),
            f"sensors and clocks {_short(self.shares.sensors.value)}",
            f"unexplained {_short(self.shares.unexplained.value)}",
        ]
        return f"Shares of the gap: {'; '.join(parts)}."

    def verdict_in_words(self) -> str:
        """What a verdict that names nothing means, and how probable it is."""
        if self.untested_change is not None:
            return " ".join(self.untested_change.in_words()[:2])
        meanings = VERDICTS_SINCE if self.reference else VERDICTS
        meaning = meanings.get(self.verdict, "")
        sure = self.probabilities.get(self.verdict)
        return meaning if sure is None else f"{meaning} Probability {sure:.2f}."

    def in_words(self) -> list[str]:
        """The shares, then what they mean, in a few plain sentences."""
        lines = [f"Left out: {text}." for text in self.left_out]
        does = self.identification
        if does is not None and does.trustworthy:
            lines.append(does.sentence())
        if self.effects or self.sensors:
            lines.append(self.shares_in_words())
        if not self.parameters:
            lines.append(self.verdict_in_words())
        lines += [f"Sensors: {text}." for text in self.sensors]
        lines += [self.rest, self.reference]
        if self.trims is not None and self.untested_change is None:
            lines.append(f"Trims and gains alone: {self.trims.sentence()}")
        if self.effects:
            lines.append(f"Where: {in_words(self.where)}.")
        lines += self._parameters_in_words()
        if self.parameters:
            lines.append(self.gap.in_words())
        return [line for line in [*lines, *self._open_in_words()] if line]

    def _open_in_words(self) -> list[str]:
        """What is left open, and what would tell it."""
        lines = []
        if self.runner_up:
            lines.append(f"Runner-up: {self.runner_up}.")
        if self.not_testable:
            lines.append(f"Not testable with these flights: {', '.join(self.not_testable)}.")
        lines.append(self.next_flight)
        if self.to_show:
            lines.append(f"To show {self.to_show}")
        return lines

    def _parameters_in_words(self) -> list[str]:
        """The named effects' values, then what is doubtful about them."""
        lines = []
        doubts = []
        for effect, estimates in self.parameters.items():
            values = [estimate.in_words(name) for name, estimate in estimates.items()]
            lines.append(f"{effect}: {', '.join(values)}.")
            if all(estimate.may_be_none for estimate in estimates.values()):
                doubts.append(
                    f"Flights disagree about {effect}: it may be none at all. Were they of one "
                    "vehicle, and alike?"
                )
        for effect, others in self.equivalent.items():
            doubts.append(f"These flights can't tell {effect} from {', '.join(others)}.")
        return lines + doubts


def _plain(value):
    """JSON-ready: dataclasses as dicts, tuples as lists, floats with six digits."""
    if is_dataclass(value):
        value = asdict(value)
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _short(value: float) -> str:
    """Two digits without a leading zero."""
    return f"{value:.2f}".replace("0.", ".", 1)

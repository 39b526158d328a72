"""The report of one case: what was found, as plain data, as text and as files."""

import json
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path

import numpy as np

from openjax.gap.identification.corrections import corrections
from openjax.gap.identification.quantities import Identification
from openjax.gap.model.library import CARDS
from openjax.gap.shares import Gap, Split
from openjax.gap.where import Place, in_words
from openjax.vehicle.effects import EFFECTS, save_effects

# What is said of each verdict that names nothing.
VERDICTS = {
    "none": "The simulator agrees with these flights to within the sensors' noise.",
    "unknown": "The simulator misses something that no known effect explains.",
    "not_testable": "No effect is seen, but these flights couldn't show most of those that are usual.",
}
# The same where a reference of the vehicle was given.
VERDICTS_SINCE = {
    "none": "The vehicle is as in its reference flights, to within what a day changes.",
    "unknown": "The vehicle changed in a way that no known effect explains.",
    "not_testable": "No change is seen, but these flights couldn't show most of those that are usual.",
}


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter with its 90 % interval, in `unit`; `usual` is the prior range;
    `may_be_none`: the interval holds the value at which the effect does nothing.
    """

    value: float
    unit: str
    interval90: tuple[float, float]
    usual: tuple[float, float]
    may_be_none: bool = False

    def in_words(self, name: str) -> str:
        """The value of the parameter `name` with its interval and unit, and whether it is
        unusual.
        """
        low, high = self.interval90
        value = f"{name} = {self.value:.4g} [{low:.4g}, {high:.4g}] {self.unit}".removesuffix(" 1")
        return value + " (unusual)" * self.unusual

    @property
    def unusual(self) -> bool:
        return not self.usual[0] <= self.value <= self.usual[1]


@dataclass(frozen=True, eq=False)
class Report:
    """What the flights of one case say. `parameters` {effect: {parameter: Estimate}}; `nuisances`
    {name: text} says what they took; `plots` holds arrays for the pictures and isn't part of the
    JSON.
    """

    case: str
    verdict: str
    effects: tuple[str, ...]
    probabilities: dict[str, float]
    shares: Split
    equivalent: dict[str, list[str]]
    parameters: dict[str, dict[str, Estimate]]
    where: list[Place]
    gap: Gap
    not_testable: list[str]
    next_flight: str
    quality: list[dict]
    runner_up: str = ""
    rest: str = ""
    sensors: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    nuisances: dict[str, str] = field(default_factory=dict)
    residual: dict[str, float] = field(default_factory=dict)
    reference: str = ""  # what the reference flights say of the vehicle; none was given
    identification: Identification | None = None  # what the vehicle does; None: no motors logged
    seconds: float = 0.0
    plots: dict = field(default_factory=dict, repr=False)

    @property
    def named(self) -> list[str]:
        """The effects without "unknown"."""
        return [e for e in self.effects if e != "unknown"]

    @property
    def left_out(self) -> list[str]:
        """Logs that weren't used, each with the reason."""
        return [f"{q['flight']}: {q['issue']}" for q in self.quality if q.get("left_out")]

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
            e: {p: asdict(v) | {"unusual": v.unusual} for p, v in found.items()}
            for e, found in self.parameters.items()
        }
        found = {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if f.name not in ("case", "plots", "seconds", "identification")
        }
        if self.identification is not None:
            of_gap = {e: share.value for e, share in self.shares.effects.items()}
            found["identification"] = self.identification.to_dict(of_gap)
        return _plain(found | {"shares": shares, "parameters": estimates})

    def class_of(self, effect: str) -> str:
        """A named effect, and those that would do as well in its place."""
        return " or ".join([effect, *self.equivalent.get(effect, ())])

    def shares_in_words(self) -> str:
        """Every named class' share with its interval, then sensors and clocks, then what is
        unexplained.
        """
        named = [(self.class_of(e), self.shares.effects[e]) for e in self.named]
        parts = ", ".join(
            f"{e} {_short(v.value)} [{_short(v.interval90[0])}, {_short(v.interval90[1])}]"
            for e, v in named
        )
        rest = f"sensors and clocks {_short(self.shares.sensors.value)}; unexplained {_short(self.shares.unexplained.value)}"
        return f"Shares of the gap: {parts}; {rest}." if parts else f"Shares of the gap: {rest}."

    def verdict_in_words(self) -> str:
        """What a verdict that names nothing means, and how probable it is."""
        sure = self.probabilities.get(self.verdict)
        meaning = (VERDICTS_SINCE if self.reference else VERDICTS).get(self.verdict, "")
        return meaning + (f" Probability {sure:.2f}." if sure is not None else "")

    def in_words(self) -> list[str]:
        """The shares, then what they mean, in a few plain sentences."""
        verdict = self.verdict_in_words()
        does = self.identification
        lines = [
            *(f"Left out: {text}." for text in self.left_out),
            *([does.sentence()] if does is not None and does.trusted else []),
            self.shares_in_words() if self.effects or self.sensors else "",
            verdict if not self.parameters else "",
            *(f"Sensors: {text}." for text in self.sensors),
            self.rest,
            self.reference,
            f"Where: {in_words(self.where)}." if self.effects else "",
            *(
                f"{e}: {', '.join(v.in_words(p) for p, v in of.items())}."
                for e, of in self.parameters.items()
            ),
            *(
                f"Flights disagree about {e}: it may be none at all. Were they of one vehicle, and "
                "alike?"
                for e, of in self.parameters.items()
                if all(v.may_be_none for v in of.values())
            ),
            *(
                f"These flights can't tell {e} from {', '.join(others)}."
                for e, others in self.equivalent.items()
            ),
            self.gap.in_words() if self.parameters else "",
            f"Runner-up: {self.runner_up}." if self.runner_up else "",
            f"Not testable with these flights: {', '.join(self.not_testable)}."
            if self.not_testable
            else "",
            f"Fly next: {self.next_flight}" if self.next_flight else "",
        ]
        return [line for line in lines if line]


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
    return f"{value:.2f}".replace("0.", ".", 1)


def to_fly(report: Report) -> tuple[dict, dict]:
    """Values and 90 % intervals by effect and parameter for a simulator that knows no voltage: the
    battery and what depends on it are as in the flights, at their median.
    """
    values = {e: {p: v.value for p, v in found.items()} for e, found in report.parameters.items()}
    intervals = {
        e: {p: v.interval90 for p, v in found.items()} for e, found in report.parameters.items()
    }
    if report.identification is not None:
        better, narrower = corrections(report.identification, report.named)
        values |= {e: values.get(e, {}) | found for e, found in better.items()}
        intervals |= {e: intervals.get(e, {}) | found for e, found in narrower.items()}
    # What wasn't fitted keeps the value at which it does nothing.
    values = {e: EFFECTS[e].none() | found for e, found in values.items()}
    evidence = report.plots.get("evidence")
    logged = (
        [t.voltage for t in evidence.tracks if t.voltage is not None]
        if evidence is not None
        else []
    )
    if not logged:
        return values, intervals
    voltage = float(np.median(np.concatenate(logged)))
    for effect, found in values.items():
        if CARDS[effect].at_voltage is not None:
            values[effect], intervals[effect] = CARDS[effect].at_voltage(
                found, intervals[effect], voltage
            )
    return values, intervals


def write_report(report: Report, folder: Path, pictures: bool = True) -> None:
    """Write `report.json`, `effects.toml` and (with `pictures`) `report.html` into an existing
    folder."""
    (folder / "report.json").write_text(
        json.dumps(report.to_dict(), indent=1) + "\n", encoding="utf-8"
    )
    values, intervals = to_fly(report)
    save_effects(folder / "effects.toml", values, intervals, notes=" ".join(report.in_words()[:2]))
    if pictures:
        from openjax.gap.report.page import page_of

        (folder / "report.html").write_text(page_of(report, folder), encoding="utf-8")

"""The findings of one case, as plain data and as text."""

from collections.abc import Collection
from dataclasses import asdict, dataclass, field, fields, is_dataclass

from openjax.gap.decision import DECISION
from openjax.gap.identification.corrections import corrections
from openjax.gap.identification.quantities import Identification, Quantity
from openjax.gap.model.library import CARDS
from openjax.gap.shares import Gap, Split
from openjax.gap.trims.change import Change
from openjax.gap.where import Place, in_words

VERDICTS = {
    "none": "The simulator agrees with these flights to within the noise of the sensors.",
    "unknown": "The simulator misses something that no known effect explains.",
    "not_testable": "No effect is seen, but these flights could not have shown most effects.",
}
"""What is said of each verdict that names nothing."""
VERDICTS_SINCE = {
    "none": "The vehicle flies as in its reference flights, within the usual spread between days.",
    "unknown": "The vehicle changed in a way that no known effect explains.",
    "not_testable": "No change is seen, but these flights could not have shown most changes.",
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
    """True if the interval holds the value at which the effect does nothing."""

    def in_words(self, name: str) -> str:
        """The value of the parameter `name` with its interval and unit, and whether it
        is unusual; the interval alone where it is no size.
        """
        low, high = self.interval90
        unit = "" if self.unit == "1" else f" {self.unit}"
        if not self.is_size:
            return f"{name} between {low:.2g} and {high:.2g}{unit}, too uncertain for a size"
        text = f"{name} = {self.value:.4g} [{low:.4g}, {high:.4g}]{unit}"
        return f"{text} (unusual)" if self.unusual else text

    @property
    def is_size(self) -> bool:
        """True if the interval tells the order of magnitude."""
        near, far = sorted(map(abs, self.interval90))
        one_sign = self.interval90[0] * self.interval90[1] > 0.0
        return not one_sign or far <= DECISION.size_ratio * near

    @property
    def unusual(self) -> bool:
        """True if all of the interval lies outside the prior range."""
        low, high = self.interval90
        return high < self.usual[0] or low > self.usual[1]


@dataclass(frozen=True, eq=False)
class Report:
    """The findings from the flights of one case."""

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
    """Advice on flying and logging for an effect that no segment shows."""
    vehicle: str = ""
    """The vehicle file of the flights."""
    runner_up: str = ""
    rest: str = ""
    """A sentence on what the named effects leave."""
    links: dict[str, Quantity] = field(default_factory=dict)
    """{"effect.parameter": number} of pose, radio and rate loop."""
    sensors: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    nuisances: dict[str, str] = field(default_factory=dict)
    """{name: what it took}."""
    residual: dict[str, float] = field(default_factory=dict)
    residual_before: dict[str, float] = field(default_factory=dict)
    """The same measures of the reference."""
    reference: str = ""
    """A sentence on the reference flights; empty if none were given."""
    trims: Change | None = None
    """The trims' evidence of a change since the reference; None: there is none, or its logs
    show none.
    """
    identification: Identification | None = None
    """The measured response; None if no motors were logged."""
    seconds: float = 0.0
    plots: dict = field(default_factory=dict, repr=False)
    """Arrays for the pictures; no part of the JSON."""

    @property
    def named(self) -> list[str]:
        """The effects without "unknown"."""
        return [e for e in self.effects if e != "unknown"]

    @property
    def change_by_trims(self) -> Change | None:
        """The change that trims and gains show beyond the spread of days, if no name explains it: a
        cause that moves trims, or one that these flights could not have shown the diagnosis.
        Otherwise None.
        """
        trims = self.trims
        if trims is None or not trims.changed or self._explains(trims):
            return None
        decides = trims.trims_changed or set(trims.effects) <= set(self.not_testable)
        return trims if decides else None

    def _explains(self, trims: Change) -> bool:
        """True if a named effect explains the change that trims show: by its name, by one that
        would do as well, or as both change the thrust.
        """
        names = {*self.named, *(o for others in self.equivalent.values() for o in others)}
        if names & set(trims.effects):
            return True
        return _scale_motion(names) and _scale_motion(trims.effects)

    @property
    def trims_in_words(self) -> list[str]:
        """By what trims differ from the reference's; what that means only where it is a
        part of the answer.
        """
        trims = self.trims
        if trims is None:
            return []
        if self.change_by_trims is not None or set(self.named) & set(trims.effects):
            return trims.measured_in_words()
        return trims.differences_in_words()

    @property
    def departures(self) -> list[str]:
        """Effects whose numbers depart from the simulator's as they were measured, and
        that aren't named.
        """
        does = self.identification
        if does is None or self.reference:
            return []
        return [e for e in corrections(does, self.named)[0] if e not in self.named]

    @property
    def numbers(self) -> dict[str, Quantity]:
        """All that was measured, by name."""
        does = self.identification
        return (does.quantities if does is not None else {}) | self.links

    @property
    def agrees(self) -> bool:
        """True if nothing differs by any measure."""
        differs = self.departures or self.change_by_trims is not None
        return self.verdict == "none" and not differs

    @property
    def title(self) -> str:
        """The answer in a word."""
        if not self.named and self.change_by_trims is not None:
            return ", ".join(self.change_by_trims.effects) or "unknown"
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
        """Remarks on the logs that were used."""
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
            "of_a_channel": self.shares.of_a_channel,
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
            plain["trims"] = self.trims.to_dict() | {"in_words": self.trims_in_words}
            if not self.named and self.change_by_trims is not None:
                plain["verdict"] = "trims"
        return _plain(plain | {"shares": shares, "parameters": estimates})

    def class_of(self, effect: str) -> str:
        """A named effect, and those that would do as well in its place."""
        return " or ".join([effect, *self.equivalent.get(effect, ())])

    def headline(self) -> str:
        """The verdict in a sentence or two: nothing else in the report is one."""
        since = bool(self.reference)
        by_trims = self.change_by_trims
        parts = []
        if self.named:
            parts.append(self._named_in_words())
            if by_trims is not None:
                parts.append(f"The trims point to more: {by_trims.causes_in_words()}.")
        elif by_trims is not None:
            parts.append(by_trims.sentence())
        else:
            parts.append((VERDICTS_SINCE if since else VERDICTS)[self.verdict])
        if self.departures and not self.effects:
            differing = "; ".join(self.identification.in_words(e) for e in self.departures)
            parts = [f"No effect is named, but the vehicle's own numbers differ: {differing}."]
        elif "unknown" in self.effects and self.verdict != "unknown":
            parts.append(f"Something unknown {'changed' if since else 'acts'} as well.")
        return " ".join(parts)

    def _named_in_words(self) -> str:
        """The share of the gap that the named effects cause, and their use for predictions."""
        what = "What changed since the reference" if self.reference else "What the simulator misses"
        values = [self.shares.effects[effect].value for effect in self.named]
        parts = " and ".join(
            f"{self.class_of(effect).replace('_', ' ')} ({100 * value:.0f} %)"
            for effect, value in zip(self.named, values, strict=True)
        )
        if sum(values) < DECISION.most_of_gap:
            rest = {
                "unexplained": self.shares.unexplained.value,
                "of sensors and clocks": self.shares.sensors.value,
            }
            other = max(rest, key=rest.get)
            text = f"{what} is {100 * rest[other]:.0f} % {other}; the named part is {parts}"
        else:
            qualifier = "" if sum(values) > 0.995 else "mostly "  # 100 % as it is printed
            text = f"{what} is {qualifier}{parts}"
        if self.parameters:
            those = "it" if len(self.named) == 1 else "them"
            smaller = f"{100 * self.gap.reduction:.0f} %"
            text += f"; with {those}, errors on held-out flights shrink by {smaller}"
        unusual = [e for e, p in self.parameters.items() if any(v.unusual for v in p.values())]
        if unusual:
            text += (
                f". {' and '.join(unusual).replace('_', ' ').capitalize()} would be unusually "
                "large: a cause that is not on the list may act instead"
            )
        return f"{text}."

    def measured_in_words(self) -> list[str]:
        """The vehicle's measured behaviour beside the simulator's, without any cause."""
        does = self.identification
        if does is None or not does.trustworthy:
            return []
        numbers = [does.in_words(e) for e in self.named if does.in_words(e)]
        others = [does.in_words(e) for e in self.departures if self.effects]
        lines = [does.sentence()]
        if numbers:
            lines.append(f"Measured: {'; '.join(numbers)}.")
        if others:
            lines.append(f"Also measured, but not named as causes: {'; '.join(others)}.")
        return lines

    def shares_in_words(self) -> str:
        """Every named class' share with its interval, then sensors and clocks, then
        what is unexplained.
        """
        rows = []
        for effect in self.named:
            share = self.shares.effects[effect]
            low, high = share.interval90
            row = f"{self.class_of(effect)} {share.value:.2f} [{low:.2f}, {high:.2f}]"
            rows.append(", ".join(filter(None, (row, self.shares.of_one_channel(effect)))))
        rows.append(f"sensors and clocks {self.shares.sensors.value:.2f}")
        rows.append(f"unexplained {self.shares.unexplained.value:.2f}")
        return f"Shares of the gap: {'; '.join(rows)}."

    def in_words(self) -> list[str]:
        """The answer, what was measured, then what is behind it, in plain sentences."""
        lines = [f"Left out: {text}." for text in self.left_out]
        sure = "" if self.effects else self.probabilities.get(self.verdict)
        lines.append(self.headline() + (f" Probability {sure:.2f}." if sure else ""))
        lines += self.measured_in_words()
        if self.effects or self.sensors:
            lines.append(self.shares_in_words())
        lines += [f"Sensors: {text}." for text in self.sensors]
        lines += [self.rest, self.reference]
        lines += self.trims_in_words
        if self.effects:
            lines.append(f"Where: {in_words(self.where)}.")
        lines += self._parameters_in_words()
        if self.parameters:
            lines.append(self.gap.in_words())
        return [line for line in [*lines, *self._open_in_words()] if line]

    def _open_in_words(self) -> list[str]:
        """Open questions, and the flights that would answer them."""
        lines = []
        if self.runner_up:
            lines.append(f"Next most probable: {self.runner_up}.")
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
                    f"Flights disagree about {effect}, which may not act at all. Was it one "
                    "vehicle, flown in the same way?"
                )
        for effect, others in self.equivalent.items():
            doubts.append(f"These flights can't tell {effect} from {', '.join(others)}.")
        return lines + doubts


def _scale_motion(effects: Collection[str]) -> bool:
    """True if one of the effects changes all accelerations in proportion."""
    return any("motion" in CARDS[e].scales for e in effects if e in CARDS)


def _plain(value):
    """JSON-ready: dataclasses as dicts, tuples as lists, floats with six digits."""
    if is_dataclass(value):
        value = asdict(value)
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value

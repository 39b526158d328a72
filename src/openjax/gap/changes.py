"""What changed since last week: two sets of flights of one vehicle, compared with each other instead of with the
simulator, so that what model and sensors share cancels.

A flight's trims (how hard it had to work to hover, and the roll, pitch and yaw that the mixer added to stay level)
repeat within a day far better than from day to day: batteries, propellers and how the frame was put together
shift them. So a day is a random effect. Its spread is learnt from the reference's days where it holds several, over
a prior; flights of one folder whose trims are far apart count as several days. Causes are compared by how well
each, with the spread of a day, predicts the change of the four trims:

    one rotor weaker by a share e     hover, roll, pitch and yaw move alike, signs by the rotor's place and spin
    two rotors weaker                 the sum of two such
    a weight beside a rotor or side   hover, roll and pitch, no yaw
    the whole vehicle                 hover alone (mass, propellers, thrust)
    something else                    no pattern

A rotor that is weaker by e at the same command is given 1 / (1 - e) of it. Drag, lag, torque and noise are
compared one by one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.stats import norm, qmc

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.flight import Case, Issue
from openjax.gap.flight_figures import TRIMS, FlightFigures, figures_of, mixer_of

# Spread (standard deviation) of a vehicle's normal days: for trims 1 to 2.5 % of hover, measured on published flights
# of two Crazyflies; yaw more, because its torque is a hundredth of thrust times arm and a tilted motor shows in it.
DAY_SPREAD = {"hover": 0.012, "roll": 0.02, "pitch": 0.02, "yaw": 0.03}
PRIOR_DAYS = 6.0  # days of experience that this prior is worth
SAME_DAY = 0.012  # of hover: roll and pitch trims further apart were flown on different days
WITHIN_DAY = {"hover": 0.003, "roll": 0.0025, "pitch": 0.0025, "yaw": 0.005}  # repeatability of a flight
VOLTAGE_SLOPE = (0.0, 0.15)  # 1/V of hover, prior mean and standard deviation
VOLTAGE_SPREAD = 0.1  # V, by which flights without a logged voltage may differ

PRIOR_CHANGED = 0.5
CAUSES = {
    "one rotor weaker": 0.3,
    "two rotors weaker": 0.3,
    "weight": 0.2,
    "whole vehicle": 0.1,
    "something else": 0.1,
}
USUAL_CHANGE = 0.15  # of a rotor's command, or of the weight
STRONGER = 0.15  # share of changes the other way: a mended rotor, a weight taken off
INEXACT = 0.25  # of each trim of a cause: real changes don't follow their pattern exactly
LEAST_PARTNER = 0.25  # a second rotor that changed by less than this share of the first isn't one
DRAWS = 2048  # of a cause's size and pattern

# What is cut, bent or taped on also shakes: the noise of gyroscope and motors rises by some 40 % or more, though air
# and battery move it as well. So it may support a change of the trims, within bounds, never start one.
SHAKES = (0.4, 0.4)  # mean and standard deviation of the logarithm's change
SUPPORT = 3.0  # largest factor on the odds

# Other figures: unit, spread of normal days, usual size of a change.
OTHERS = {
    "drag_x": ("1/s", 0.04, 0.3),
    "drag_y": ("1/s", 0.04, 0.3),
    "lag": ("s", 0.005, 0.03),
    "torque_gain": ("", 0.07, 0.3),
    "gyroscope_noise": ("", 0.35, 1.0),
    "accelerometer_noise": ("", 0.35, 1.0),
    "motor_noise": ("", 0.35, 1.0),
}
OTHER_CHANGED = 0.1  # prior probability of each of them

SHOWN = 0.5  # probability from which on something is said to have changed

ROTOR_PLACES = ("front right", "rear right", "rear left", "front left")
_SIDES = {
    (0, 1): "right",
    (1, 2): "rear",
    (2, 3): "left",
    (0, 3): "front",
    (0, 2): "diagonal",
    (1, 3): "diagonal",
}
_EVERYWHERE = (0, 1, 2, 3)


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class OtherFigure:
    """A figure besides the trims: how it differs, and the probability that this is more than a day's."""

    name: str
    unit: str
    difference: Interval
    probability: float


@dataclass(frozen=True)
class Change:
    """What differs between two sets of flights.

    `probability` that the vehicle changed, and whether its trims did (`trims_changed`). `places` {rotors: p} and
    `causes` {cause: p} say how probable each is if the trims changed (`causes_here`: at the most probable place);
    rotors count 1 to 4 as logged (m1..m4).
    `size` is the thrust that was lost, as a share of one rotor's, at the most probable place (for a weight: its share
    of a rotor's load); `trims` are the differences, their intervals with the spread of a day in them; `least` is
    the loss of a single rotor that these flights would have shown.
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
    trims: dict[str, Interval]
    others: tuple[OtherFigure, ...]
    least: float
    reference: tuple[FlightFigures, ...]
    flights: tuple[FlightFigures, ...]
    quality: tuple[Issue, ...]
    spread: dict[str, float]  # of normal days, as estimated

    @property
    def days(self) -> int:
        """Days that the reference holds."""
        return len({f.day for f in self.reference})

    @property
    def likely_causes(self) -> tuple[str, ...]:
        """The most probable cause at the most probable place, and those that these flights can't split from it."""
        top = max(self.causes_here.values())
        likely = [c for c, p in self.causes_here.items() if p > 0.25 * top]
        return tuple(sorted(likely, key=lambda c: -self.causes_here[c]))

    @property
    def effects(self) -> tuple[str, ...]:
        """What changed by the names of the effect library, the most probable first."""
        names: list[str] = []
        if self.trims_changed:
            names += [effect for cause in self.likely_causes for effect in _EFFECTS[cause]]
        names += [_EFFECTS[o.name][0] for o in self.others if o.probability > SHOWN and o.name in _EFFECTS]
        return tuple(dict.fromkeys(names))


_EFFECTS = {
    "one rotor weaker": ("motor_imbalance",),
    "two rotors weaker": ("motor_imbalance",),
    "weight": ("mass", "com_offset"),
    "whole vehicle": ("mass", "thrust_scale"),
    "something else": (),
    "drag_x": ("rotor_drag",),
    "drag_y": ("rotor_drag",),
    "lag": ("motor_lag",),
    "torque_gain": ("inertia",),
}


def compare(flights: Path, references: Sequence[Path]) -> Change:
    """What changed in the flights of a folder against those of one or more reference folders (days).

    Raises UserError for a folder without a usable flight and for flights of several vehicles."""
    new_case, new, quality = read(Path(flights))
    old: list[FlightFigures] = []
    for folder in references:
        case, figures, found = read(Path(folder))
        if {f.vehicle for f in case.flights} != {f.vehicle for f in new_case.flights}:
            raise UserError(f"{folder}: holds flights of another vehicle than {flights}")
        old += figures
        quality += found
    return change_between(Path(flights).resolve().name, new, old, new_case, tuple(quality))


def read(folder: Path) -> tuple[Case, list[FlightFigures], list[Issue]]:
    case = load_case(folder, comparison=True)
    if len({f.vehicle for f in case.flights}) > 1:
        raise UserError(f"{folder}: holds several vehicles; a comparison is of one vehicle with itself")
    quality, figures = list(case.quality), []
    for flight in case.flights:
        found = figures_of(flight, case, str(folder))
        if isinstance(found, str):
            quality.append(Issue(flight.name, found, refused=True, kind="comparison"))
        else:
            figures.append(found)
    if not figures:
        reasons = "; ".join(dict.fromkeys(i.issue for i in quality if i.refused))
        raise UserError(f"{folder}: no flight can be compared: {reasons}")
    return case, days_told_apart(figures), quality


def days_told_apart(figures: Sequence[FlightFigures]) -> list[FlightFigures]:
    """The flights of one folder with their days: those whose roll and pitch trims lie further apart than flights of
    a day ever do count as flown on different days."""
    if len(figures) < 2:
        return list(figures)
    trims = np.array([f.trims()[0][1:3] for f in figures])
    error = max(float(np.median([f.trims()[1][1:3].max() for f in figures])), 1e-9)
    groups = fcluster(linkage(trims, "complete"), max(SAME_DAY, 3.0 * error), "distance")
    return [dataclasses.replace(f, day=f"{f.day}#{g}") for f, g in zip(figures, groups, strict=True)]


def change_between(
    name: str,
    new: Sequence[FlightFigures],
    old: Sequence[FlightFigures],
    case: Case,
    quality: tuple[Issue, ...] = (),
) -> Change:
    """`compare` for figures that are there already; `case` gives the vehicle's geometry and motor order."""
    mixer = mixer_of(case.vehicle_of(case.flights[0]))
    battery = _battery([*new, *old])
    before, after = (_by_day(f, battery) for f in (old, new))
    spread, freedom = _spread_of_days(before, after)
    difference = after.mean - before.mean
    scale = np.sqrt(
        spread**2 * (1 / len(before.days) + 1 / len(after.days)) + before.error**2 + after.error**2
    )
    hypotheses = _hypotheses(mixer, before.mean)
    others = _others(new, old)
    evidence = _weigh(hypotheses, difference, scale, freedom, _support(others))
    logged = [case.vehicle_file.motor_permutation[j] + 1 for j in range(4)]
    place, within = evidence.place()
    unchanged = 1.0 - evidence.changed
    for other in others:
        unchanged *= 1.0 - other.probability if not other.name.endswith("noise") else 1.0
    reach = 1.645 * scale
    return Change(
        name=name,
        changed=unchanged < 1.0 - SHOWN,
        probability=1.0 - unchanged,
        trims_changed=evidence.changed > SHOWN,
        rotors=tuple(sorted(logged[j] for j in place)),
        side=ROTOR_PLACES[place[0]] if len(place) == 1 else _SIDES.get(place, ""),
        causes=evidence.causes,
        causes_here=evidence.causes_at(within),
        places={tuple(sorted(logged[j] for j in p)): share for p, share in evidence.places.items()},
        size=evidence.size(within),
        trims={
            n: Interval(float(d), float(d - r), float(d + r))
            for n, d, r in zip(TRIMS, difference, reach, strict=True)
        },
        others=others,
        least=_least(hypotheses, mixer, before.mean, scale, freedom),
        reference=tuple(old),
        flights=tuple(new),
        quality=quality,
        spread=dict(zip(TRIMS, spread.tolist(), strict=True)),
    )


@dataclass(frozen=True)
class _Days:
    days: np.ndarray  # (D, 4) logarithm of hover, roll, pitch, yaw
    mean: np.ndarray  # (4,)
    error: np.ndarray  # (4,) of the mean, without the spread of days


@dataclass(frozen=True)
class _Battery:
    voltage: float  # V, at which hover is compared: the mean of all flights that logged it
    slope: float  # 1/V, of the logarithm of hover
    error: float  # of the slope


def _battery(figures: Sequence[FlightFigures]) -> _Battery:
    """How hover follows the battery's voltage: flights of a day against each other, since neither the day nor a
    change can enter there."""
    mean, sigma = VOLTAGE_SLOPE
    xx, xy, voltages = 0.0, 0.0, []
    for day in {f.day for f in figures}:
        pairs = [
            (f.voltage, np.log(f.values["hover"][0]))
            for f in figures
            if f.day == day and f.voltage is not None
        ]
        if pairs:
            v, h = np.array(pairs).T
            voltages += v.tolist()
            xx += ((v - v.mean()) ** 2).sum()
            xy += ((v - v.mean()) * (h - h.mean())).sum()
    noise = WITHIN_DAY["hover"] ** 2
    precision = xx / noise + 1 / sigma**2
    voltage = float(np.mean(voltages)) if voltages else 0.0
    return _Battery(voltage, float((xy / noise + mean / sigma**2) / precision), float(precision**-0.5))


def _by_day(figures: Sequence[FlightFigures], battery: _Battery) -> _Days:
    within = np.array([WITHIN_DAY[n] for n in TRIMS])
    days, variances = [], []
    for day in dict.fromkeys(f.day for f in figures):
        values, errors = [], []
        for flight in (f for f in figures if f.day == day):
            value, error = flight.trims()
            error = error.copy()
            error[0] /= value[0]
            value = np.r_[np.log(value[0]), value[1:]]
            if flight.voltage is None:
                error[0] = np.hypot(error[0], np.hypot(battery.slope, battery.error) * VOLTAGE_SPREAD)
            else:
                value[0] -= battery.slope * (flight.voltage - battery.voltage)
                error[0] = np.hypot(error[0], battery.error * (flight.voltage - battery.voltage))
            values.append(value)
            errors.append(np.hypot(error, within))
        precision = 1 / np.array(errors) ** 2
        days.append((np.array(values) * precision).sum(0) / precision.sum(0))
        variances.append(1 / precision.sum(0))
    return _Days(np.array(days), np.mean(days, 0), np.sqrt(np.mean(variances, 0) / len(days)))


def _spread_of_days(*sets: _Days) -> tuple[np.ndarray, float]:
    """Standard deviation (4,) of normal days and the degrees of freedom behind it: the prior and what the days of each
    set show."""
    freedom, total = PRIOR_DAYS, PRIOR_DAYS * np.array([DAY_SPREAD[n] for n in TRIMS]) ** 2
    for one in sets:
        freedom += len(one.days) - 1
        total = total + ((one.days - one.mean) ** 2).sum(0)
    return np.sqrt(total / freedom), freedom


@dataclass(frozen=True)
class _Hypotheses:
    """Draws from all causes: change of the trims (N, 4), prior weight, cause, place and size of each."""

    change: np.ndarray
    weight: np.ndarray
    cause: np.ndarray  # (N,) index into CAUSES
    place: np.ndarray  # (N,) index into `places`
    size: np.ndarray
    places: tuple[tuple[int, ...], ...]


def _hypotheses(mixer: np.ndarray, trims: np.ndarray) -> _Hypotheses:
    # Even draws of: two sizes, their sign, two places, four shares of inexactness.
    draws = qmc.Sobol(9, seed=0).random(DRAWS)
    draws = np.clip(draws, 1e-6, 1 - 1e-6)
    sizes = np.abs(norm.ppf(0.5 + 0.5 * draws[:, :2])) * USUAL_CHANGE
    sign = np.where(draws[:, 2] < STRONGER, -1.0, 1.0)
    sizes = sizes * sign[:, None]
    inexact = 1.0 + INEXACT * norm.ppf(draws[:, 5:])
    place_of = {p: k for k, p in enumerate([(0,), (1,), (2,), (3,), *_SIDES, _EVERYWHERE, ()])}
    # Rotor commands in level flight of the reference, in units of their mean: columns of the inverse mixer.
    level = np.linalg.solve(mixer, np.r_[1.0, trims[1:]])
    signs = 4.0 * mixer[1:3]
    parts = []

    def add(cause, share, factors, places, size):
        command = level * np.maximum(factors, 0.2)
        mixed = command @ mixer.T
        change = np.c_[np.log(mixed[:, 0]), mixed[:, 1:] / mixed[:, :1] - trims[1:]] * inexact
        parts.append((change, np.full(DRAWS, share * CAUSES[cause] / DRAWS), cause, places, size))

    lost = sizes / (1.0 + sizes)  # a rotor that needs 1 + d of its command has lost d / (1 + d)
    for rotor in range(4):
        factors = np.ones((DRAWS, 4))
        factors[:, rotor] += sizes[:, 0]
        add("one rotor weaker", 0.25, factors, np.full(DRAWS, rotor), lost[:, 0])
    for pair, side in _SIDES.items():
        factors = np.ones((DRAWS, 4))
        factors[:, pair] += sizes
        places = np.full(DRAWS, place_of[pair])
        for one, other in ((0, 1), (1, 0)):
            alone = np.abs(sizes[:, other]) < LEAST_PARTNER * np.abs(sizes[:, one])
            places[alone] = pair[one]
        add("two rotors weaker", 0.05 if side == "diagonal" else 0.225, factors, places, lost.sum(1))
    # A weight within the circle through the rotors, in units of their distance from the axes.
    radius, angle = np.sqrt(2.0 * draws[:, 3]), 2 * np.pi * draws[:, 4]
    left, rear = radius * np.cos(angle), radius * np.sin(angle)
    weight = sizes[:, 0]
    factors = 1.0 + weight[:, None] * (1.0 + left[:, None] * signs[0] + rear[:, None] * signs[1])
    near = np.clip(0.5 * (left[:, None] * signs[0] + rear[:, None] * signs[1]), -1.0, 1.0)
    places = np.array([place_of.get(_beside(row), place_of[_EVERYWHERE]) for row in near])
    add("weight", 1.0, factors, places, 4.0 * weight)
    add(
        "whole vehicle",
        1.0,
        np.repeat(1.0 + sizes[:, :1], 4, 1),
        np.full(DRAWS, place_of[_EVERYWHERE]),
        4.0 * weight,
    )
    anything = USUAL_CHANGE / 2 * norm.ppf(draws[:, 5:])
    parts.append((anything, np.full(DRAWS, CAUSES["something else"] / DRAWS), "something else",
                  np.full(DRAWS, place_of[()]), np.abs(anything).sum(1)))  # fmt: skip
    causes = list(CAUSES)
    return _Hypotheses(
        *(np.concatenate([p[k] for p in parts]) for k in (0, 1)),
        np.repeat([causes.index(p[2]) for p in parts], DRAWS),
        *(np.concatenate([p[k] for p in parts]) for k in (3, 4)),
        tuple(place_of),
    )


def _beside(near: np.ndarray) -> tuple[int, ...]:
    """The rotors beside a weight, from how near (4,) -1 to 1 it is to each: one, two of a side, or all."""
    order = np.argsort(-near)
    if near[order[0]] < 0.3:
        return _EVERYWHERE
    if near[order[0]] - near[order[1]] > 0.4:
        return (int(order[0]),)
    return tuple(sorted(int(i) for i in order[:2]))


@dataclass(frozen=True)
class _Evidence:
    changed: float
    causes: dict[str, float]
    places: dict[tuple[int, ...], float]
    posterior: np.ndarray
    hypotheses: _Hypotheses

    def place(self) -> tuple[tuple[int, ...], list[tuple[int, ...]]]:
        """The smallest place that holds more than half of the probability, and the places within it: a rotor, two
        rotors, a side (one or both of its rotors), else what is most probable."""
        best = max(self.places, key=lambda p: self.places[p])
        if self.places[best] > 0.5:
            return best, [best]
        sides = {side: [side, side[:1], side[1:]] for side, name in _SIDES.items() if name != "diagonal"}
        shares = {side: sum(self.places[p] for p in within) for side, within in sides.items()}
        side = max(shares, key=lambda p: shares[p])
        return (side, sides[side]) if shares[side] > 0.5 else (best, [best])

    def _within(self, places: list[tuple[int, ...]]) -> np.ndarray:
        return np.isin(self.hypotheses.place, [self.hypotheses.places.index(p) for p in places])

    def causes_at(self, places: list[tuple[int, ...]]) -> dict[str, float]:
        """Probability of each cause at some places."""
        here = self._within(places)
        each = np.bincount(self.hypotheses.cause[here], self.posterior[here], len(CAUSES))
        return dict(zip(CAUSES, (each / each.sum()).tolist(), strict=True))

    def size(self, places: list[tuple[int, ...]]) -> Interval:
        """Median and 90 % interval of the size at some places."""
        here = self._within(places)
        order = np.argsort(self.hypotheses.size[here])
        share = np.cumsum(self.posterior[here][order])
        values = self.hypotheses.size[here][order]
        low, middle, high = (float(values[np.searchsorted(share, q * share[-1])]) for q in (0.05, 0.5, 0.95))
        return Interval(middle, low, high)


def _support(others: Sequence[OtherFigure]) -> float:
    """Factor on the odds of a change from the noise of gyroscope and motors."""
    noise = [o for o in others if o.name in ("gyroscope_noise", "motor_noise")]
    if not noise:
        return 1.0
    rise = np.mean([o.difference.value for o in noise])
    spread = np.mean([(o.difference.high - o.difference.low) / 3.29 for o in noise])
    logs = norm.logpdf(rise, SHAKES[0], np.hypot(spread, SHAKES[1])) - norm.logpdf(rise, 0.0, spread)
    return float(np.clip(np.exp(logs), 1 / SUPPORT, SUPPORT))


def _weigh(hypotheses: _Hypotheses, difference, scale, freedom: float, support: float = 1.0) -> _Evidence:
    """Posterior of every cause, place and size: Student's distribution around the change that each predicts."""

    def log_density(rest: np.ndarray) -> np.ndarray:
        return -0.5 * (freedom + 1.0) * np.log1p((rest / scale) ** 2 / freedom).sum(-1)

    none = log_density(difference)
    each = np.log(hypotheses.weight) + log_density(difference - hypotheses.change)
    top = max(each.max(), none)
    posterior = support * PRIOR_CHANGED * np.exp(each - top)
    total = posterior.sum() + (1.0 - PRIOR_CHANGED) * np.exp(none - top)
    changed = float(posterior.sum() / total)
    posterior /= posterior.sum()
    causes = {c: float(posterior[hypotheses.cause == k].sum()) for k, c in enumerate(CAUSES)}
    places = {p: float(posterior[hypotheses.place == k].sum()) for k, p in enumerate(hypotheses.places)}
    return _Evidence(changed, causes, places, posterior, hypotheses)


def _least(hypotheses, mixer, trims, scale, freedom) -> float:
    """The loss of a single rotor that would just be said to be a change, whichever rotor it is."""
    level = np.linalg.solve(mixer, np.r_[1.0, trims[1:]])
    worst = 0.0
    for rotor in range(4):
        low, high = 0.0, 1.0
        for _ in range(8):
            middle = 0.5 * (low + high)
            command = level.copy()
            command[rotor] *= 1.0 + middle
            mixed = mixer @ command
            change = np.r_[np.log(mixed[0]), mixed[1:] / mixed[0] - trims[1:]]
            shown = _weigh(hypotheses, change, scale, freedom).changed > SHOWN
            low, high = (low, middle) if shown else (middle, high)
        worst = max(worst, high / (1.0 + high))
    return worst


def _others(new: Sequence[FlightFigures], old: Sequence[FlightFigures]) -> tuple[OtherFigure, ...]:
    """Drag, lag, torque and noise: each a day's spread or a change of the usual size."""
    out = []
    for name, (unit, day_spread, usual) in OTHERS.items():
        sets = []
        for figures in (old, new):
            days = []
            for day in dict.fromkeys(f.day for f in figures):
                own = [f.values[name] for f in figures if f.day == day and name in f.values]
                if own:
                    value, error = np.array(own).T
                    days.append(
                        (
                            value.mean(),
                            np.hypot(error.mean() / np.sqrt(len(own)), value.std() / len(own) ** 0.5),
                        )
                    )
            sets.append(days)
        if not all(sets):
            continue
        means = [np.mean([d[0] for d in days]) for days in sets]
        freedom = PRIOR_DAYS + sum(len(days) - 1 for days in sets)
        total = PRIOR_DAYS * day_spread**2 + sum(np.var([d[0] for d in days]) * len(days) for days in sets)
        variance = sum(
            total / freedom / len(days) + np.mean([d[1] ** 2 for d in days]) / len(days) for days in sets
        )
        difference = means[1] - means[0]
        # A change of the usual size widens the same distribution.
        logs = [
            -0.5 * np.log(v) - 0.5 * (freedom + 1) * np.log1p(difference**2 / v / freedom)
            for v in (variance, variance + usual**2)
        ]
        odds = OTHER_CHANGED / (1 - OTHER_CHANGED) * np.exp(logs[1] - logs[0])
        reach = 1.645 * np.sqrt(variance)
        out.append(OtherFigure(name, unit, Interval(float(difference), float(difference - reach),
                                                    float(difference + reach)), float(odds / (1 + odds))))  # fmt: skip
    return tuple(out)

"""Calibration: the nominal vehicle's own constants from flights, with intervals and with what can't be told.

It is a fit of `thrust_scale`, `inertia`, `motor_lag` and `yaw_torque` by the diagnosis's own replay, noise models and
nuisances, all four at once and whatever their size, beside what acts in every flight and would pass for them: drag, wind,
an offset centre of mass, rotors that differ."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.gap.evidence import Evidence, gather
from openjax.gap.hypotheses import UNEXPOSED, SetFit, fit_set, without_nuisances
from openjax.gap.intervals import robust_deviation
from openjax.gap.library import CARDS, PLACE, Library
from openjax.gap.replay import FORCE, RATES, VELOCITY, Replay
from openjax.gap.table import HORIZONS
from openjax.vehicle.vehicle_file import CALIBRATED_UNITS, CalibratedValue

CONSTANTS = ("thrust_scale", "inertia", "motor_lag", "yaw_torque")
BESIDE = ("rotor_drag", "wind", "com_offset", "motor_imbalance")
Z90 = 1.645
TOLD = 0.5  # of a prior's spread: a constant known no better isn't determined by the flights
LEAST_EXPLAINED = 0.75  # share of the rates' changes; below, no constant that they tell can be trusted
YAW_INERTIA_RANGE = (0.7, 1.6)  # of nominal; what it may be where it is assumed
# Relative error (standard deviation) that remains however long one flies: commands and states are known every
# 10 ms only, and thrust differs by up to a per cent from flight to flight.
MODEL_ERROR = {
    "thrust_constant": 0.005,
    "torque_constant": 0.01,
    "motor_time_constant": 0.02,
    "inertia": 0.01,
}

# What flights can't tell, in words.
_YAW_CLASS = (
    "yaw torque constant against yaw inertia: only their ratio shows in yaw; the inertia is assumed nominal"
)
_NOT_WEIGHED = (
    "mass against thrust: the mass wasn't weighed, so thrust and torque constants and inertia hold for the "
    "assumed {grams:.1f} g; a mass off by 1 % moves them all by 1 %. Weigh the vehicle"
)
_UNKNOWN_MAP = (
    "the thrust constant: the commands are duty cycles whose map to thrust isn't known. Against the public "
    "map the flights' thrust per assumed mass is {scale:.3g}; torques were scaled alike"
)
_NOT_EXPLAINED = (
    "inertia, torque constant, motor lag: motors explain only {share:.0%} of what the gyroscope shows. "
    "Their clocks may disagree, or something else acts: run openjax.diagnose"
)
_ROWS = (
    "inertia, torque constant, motor lag: rows of the motors can't be told from single samples here, or their "
    "clock drifts against the gyroscope's; log commands and motors on one clock, faster"
)
_ADVICE = {
    "thrust_constant": "climb and descend hard, or log the pose",
    "torque_constant": "turn left and right sharply",
    "motor_time_constant": "change thrust or rates sharply, with motors and IMU logged on one clock",
    "inertia": "roll and pitch sharply left and right",
}


@dataclass(frozen=True)
class Quantity:
    """A fitted constant: value, 90 % interval and nominal value, each a tuple of length 1 (3 for inertia)."""

    value: tuple[float, ...]
    interval90: tuple[tuple[float, float], ...]
    nominal: tuple[float, ...]
    unit: str
    determined: bool
    notes: str = ""


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration. `cannot_tell` says in words what these flights leave open; `beside` {effect: {parameter:
    value}} what was fitted beside the constants; `explained` the share of each kind of channel's changes that the given
    vehicle explains, and the fitted one; `seconds` of flight."""

    quantities: dict[str, Quantity]
    cannot_tell: tuple[str, ...]
    beside: dict[str, dict[str, float]] = field(default_factory=dict)
    explained: dict[str, tuple[float, float]] = field(default_factory=dict)
    flights: tuple[str, ...] = ()
    seconds: float = 0.0

    def calibrated(self) -> dict[str, CalibratedValue]:
        """What goes into the vehicle file: determined quantities only."""
        return {
            name: CalibratedValue(q.value, q.interval90, q.notes)
            for name, q in self.quantities.items()
            if q.determined
        }


def calibrate(case: Case) -> Calibration:
    """Fit thrust constant, torque constant, motor time constant and inertia to a case's flights.

    Raises UserError if no flight holds motor commands and body rates.
    """
    if not any(f.motor_command is not None and f.body_rates is not None for f in case.flights):
        raise UserError(
            f"{case.name}: no flight holds motor commands (m1..m4) and the gyroscope; calibration needs both"
        )
    evidence = gather(case, Library((*CONSTANTS, *BESIDE)))
    replay = _without_numbers(evidence.replay)
    beside = [e for e in BESIDE if evidence.exposure.get(e, 0.0) >= UNEXPOSED]
    fit = fit_set(replay, (*CONSTANTS, *beside))
    return _result(evidence, replay, fit, beside)


def _without_numbers(replay: Replay) -> Replay:
    """The replay without small errors of the constants among its nuisances: here they are what is asked for."""
    own = {f"{effect} {parameter}" for effect, parameter, _ in replay.numbers if effect in CONSTANTS}
    stays = [k for k, name in enumerate(replay.nuisance_names) if name not in own]
    free = dataclasses.replace(
        replay,
        nuisances=[n[stays] for n in replay.nuisances],
        nuisance_names=tuple(replay.nuisance_names[k] for k in stays),
        shared=replay.shared[stays],
        numbers=tuple(key for key in replay.numbers if key[0] not in CONSTANTS),
    )
    free.set_noise(replay.noises)
    return free


def _result(evidence: Evidence, replay: Replay, fit: SetFit, beside) -> Calibration:
    case = evidence.case
    vehicle, file = evidence.vehicles[0], case.vehicle_file
    weighed, pwm = file.mass_weighed, file.motor_command == "pwm"
    widened = robust_deviation(fit) / np.sqrt(np.diag(fit.covariance))
    covariance = fit.covariance * np.outer(widened, widened)
    order = fit.index.tolist()

    def read(parts: dict[tuple[str, str], float]) -> tuple[float, float]:
        """Sum of parameters, each times its factor, and the sum's standard deviation."""
        weights = np.zeros(len(order))
        for key, factor in parts.items():
            weights[order.index(PLACE[key])] = factor
        return float(weights @ fit.theta[fit.index]), float(np.sqrt(weights @ covariance @ weights))

    def logarithm(value: float, deviation: float) -> tuple[float, float]:
        value = max(value, 1e-3)
        return float(np.log(value)), deviation / value

    scale = read({("thrust_scale", "scale"): 1.0})
    ratio, zz = read({("yaw_torque", "ratio"): 1.0})[0], read({("inertia", "zz"): 1.0})[0]
    # Only their ratio shows: the yaw torque of a vehicle whose inertia about z is nominal.
    yaw = read({("yaw_torque", "ratio"): 1.0 / zz, ("inertia", "zz"): -ratio / zz**2})[1]
    nominal_lag = float(vehicle.motor_time_constant)
    lag = read({("motor_lag", "extra_up"): 0.5, ("motor_lag", "extra_down"): 0.5})
    thrust = (0.0, 0.0) if pwm else logarithm(1.0 + scale[0], scale[1])
    logs = {
        "thrust_constant": [thrust],
        "torque_constant": [tuple(np.add(logarithm(ratio / zz, yaw), (thrust[0], 0.0)))],
        "motor_time_constant": [logarithm(1.0 + lag[0] / nominal_lag, lag[1] / nominal_lag)],
        "inertia": [logarithm(*read({("inertia", axis): 1.0})) for axis in ("xx", "yy")] + [(0.0, 0.0)],
    }
    if pwm:  # with the thrust constant kept, torques and so inertia are of that vehicle
        logs["inertia"][:2] = [(x - np.log(1.0 + scale[0]), s) for x, s in logs["inertia"][:2]]
    spreads = {
        "thrust_constant": _spread("thrust_scale"),
        "torque_constant": _spread("yaw_torque"),
        "motor_time_constant": _spread("motor_lag") / nominal_lag,
        "inertia": _spread("inertia"),
    }
    explained = _explained(replay, fit)
    told = {n: max(s for _, s in own) < TOLD * spreads[n] for n, own in logs.items()}
    readable = evidence.exposure.get("inertia", 0.0) > 0.0
    rates_fit = readable and explained["body rates"][1] > LEAST_EXPLAINED
    untold = ["thrust_constant"] if pwm else []
    if not rates_fit:
        untold += ["torque_constant", "motor_time_constant", "inertia"]
    quantities = {
        name: _quantity(vehicle, name, own, told[name] and name not in untold, _notes(name, weighed))
        for name, own in logs.items()
    }
    cannot = []
    if pwm:
        cannot.append(_UNKNOWN_MAP.format(scale=1.0 + scale[0]))
    if not weighed:
        cannot.append(_NOT_WEIGHED.format(grams=float(vehicle.mass) * 1e3))
    cannot.append(_YAW_CLASS)
    if not readable:
        cannot.append(_ROWS)
    elif not rates_fit:
        cannot.append(_NOT_EXPLAINED.format(share=max(explained["body rates"][1], 0.0)))
    for name, advice in _ADVICE.items():
        if name not in untold and not told[name]:
            cannot.append(f"{name.replace('_', ' ')}: these flights hardly excite it; {advice}")
    found = fit.parameters()
    return Calibration(
        quantities=quantities,
        cannot_tell=tuple(cannot),
        beside={e: {p: v for p, (v, _) in found[e].items()} for e in beside},
        explained=explained,
        flights=tuple(dict.fromkeys(t.flight for t in evidence.tracks)),
        seconds=float(sum(len(t) * t.dt for t in evidence.tracks)),
    )


def _spread(effect: str) -> float:
    card = CARDS[effect]
    return float(np.hypot(card.fitted[0].spread, card.common))


def _quantity(vehicle, name: str, logs, determined: bool, notes: str) -> Quantity:
    nominal = np.atleast_1d(np.asarray(getattr(vehicle, name), float)).tolist()
    value = tuple(float(n * np.exp(x)) for n, (x, _) in zip(nominal, logs, strict=True))
    pairs = []
    for v, (_, s) in zip(value, logs, strict=True):
        reach = Z90 * np.hypot(s, MODEL_ERROR[name])
        pairs.append((float(v * np.exp(-reach)), float(v * np.exp(reach))))
    if name == "inertia":
        pairs[2] = tuple(f * nominal[2] for f in YAW_INERTIA_RANGE)
    return Quantity(value, tuple(pairs), tuple(nominal), CALIBRATED_UNITS[name], determined, notes)


def _notes(name: str, weighed: bool) -> str:
    mass = "" if weighed else "for the assumed mass, which wasn't weighed"
    extra = {"inertia": "zz is assumed nominal", "torque_constant": "for the nominal inertia about z"}
    if name in ("motor_time_constant", "torque_constant"):
        mass = ""
    return "; ".join(n for n in (extra.get(name, ""), mass) if n)


def _explained(replay: Replay, fit: SetFit) -> dict[str, tuple[float, float]]:
    """Per kind of channel: the share of its changes over the diagnosis's horizons that the given vehicle explains, and the
    fitted one, nuisances taken off both."""
    steps = {
        "body rates": (RATES, HORIZONS["rates"]),
        "velocity": (VELOCITY, HORIZONS["velocity"]),
        "specific force": (FORCE, HORIZONS["rates"]),
    }
    squares = {kind: np.zeros(3) for kind, (axes, _) in steps.items() if replay.usable[axes].any()}
    for number, track in enumerate(replay.tracks):
        measured = replay.measured[number]
        left = [
            without_nuisances(replay, r, number)
            for r in (measured - replay.nominal[number], fit.columns[number][0])
        ]
        for kind in squares:
            axes, horizon = steps[kind]
            step = max(round(horizon / track.dt), 1)
            for k, x in enumerate((measured, *left)):
                squares[kind][k] += ((x[step:] - x[:-step])[:, axes] ** 2).sum()
    return {kind: (1.0 - s[1] / s[0], 1.0 - s[2] / s[0]) for kind, s in squares.items()}

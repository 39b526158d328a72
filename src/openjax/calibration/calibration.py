"""Calibration: the nominal vehicle's own constants from flights, with intervals and with what can't be told.

Gauss-Newton on the equations of `calibration_model`, nuisances free within weak priors. Residuals of real
flights are coloured, so errors come from blocks of time and from leaving flights out, never from counting
rows.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from openjax.calibration.fit import CalibrationFit
from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.flights.track import tracks_of
from openjax.vehicle.vehicle_file import CALIBRATED_UNITS, CalibratedValue

Z90 = 1.645
DETERMINED = 0.25  # standard deviation of the logarithm below which a quantity counts as determined
LEAST_EXPLAINED = 0.75  # share of the rates' changes; below, no constant that they tell can be trusted
YAW_INERTIA_RANGE = (0.7, 1.6)  # of nominal; what it may be where it is assumed
# Relative error (standard deviation) that remains however long one flies: commands and states are known every
# 10 ms only, and thrust differs by up to a per cent from flight to flight. Measured by closed loop.
MODEL_ERROR = {
    "thrust_constant": 0.005,
    "torque_constant": 0.005,
    "motor_time_constant": 0.02,
    "inertia": 0.004,
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
    "map the flights' thrust per assumed mass is {scales}; torques were scaled alike"
)
_NOT_EXPLAINED = (
    "inertia, torque constant, motor lag: motors explain only {share:.0%} of what the gyroscope shows. "
    "Their clocks may disagree, or something else acts: run openjax.diagnose"
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
    """Result of a calibration. `cannot_tell` says in words what these flights leave open; `nuisances` what
    the sensors' offsets took, {name: (value, unit)}; `explained` the share of each channel's variation that
    the fitted vehicle explains, and with the nominal one."""

    quantities: dict[str, Quantity]
    cannot_tell: tuple[str, ...]
    nuisances: dict[str, tuple[float, str]] = field(default_factory=dict)
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
    tracks = [t for t in tracks_of(case) if t.motor is not None and t.body_rates is not None]
    if not tracks:
        raise UserError(
            f"{case.name}: no flight holds motor commands (m1..m4) and the gyroscope; calibration needs both"
        )
    ids = {f.name: f.vehicle for f in case.flights}
    vehicles = [case.vehicle_file.vehicle_of(ids[t.name.partition("#")[0]]) for t in tracks]
    fit = CalibrationFit(case, tracks, vehicles)
    fit.run()
    return _result(case, fit)


def _result(case: Case, fit: CalibrationFit) -> Calibration:
    vehicle, file = fit.vehicles[0], case.vehicle_file
    index = {n: i for i, n in enumerate(fit.names)}
    thrust = [index[n] for n in fit.names if n.startswith("thrust")]
    size = len(fit.names) + 1
    weighed = file.mass_weighed

    def combined(parts: dict[int, float]) -> tuple[float, float]:
        """Log of a product of powers of parameters, and its standard deviation."""
        gradient = np.zeros(size)
        value = 0.0
        for i, power in parts.items():
            value += power * np.log(max(fit.beta[i], 1e-3))
            gradient[i] = power / max(fit.beta[i], 1e-3)
        return value, float(np.sqrt(gradient @ fit.covariance @ gradient))

    share = {i: 1.0 / len(thrust) for i in thrust}
    logs = {"thrust_constant": combined(share)}
    for axis in ("roll", "pitch"):
        logs[axis] = combined(share | {index[axis]: -1.0})
    # With duty cycles the torque constant is that of a vehicle whose thrust constant stays nominal.
    yaw = {index["yaw"]: 1.0}
    logs["torque_constant"] = combined(yaw | {i: -p for i, p in share.items()} if fit.per_flight else yaw)
    logs["motor_time_constant"] = (fit.lag - fit.log_nominal, float(np.sqrt(fit.covariance[-1, -1])))
    # What the gyroscope's noise moves through the rate loop looks like motors that do little: with weak
    # excitation the rates' constants are off by about the share of the rates that stays unexplained.
    for name, channels in {
        "roll": 0,
        "pitch": 1,
        "torque_constant": 2,
        "motor_time_constant": (0, 1, 2),
    }.items():
        value, deviation = logs[name]
        logs[name] = value, float(np.hypot(deviation, 1.0 - min(_share(fit, fit.residual, channels), 1.0)))

    quantities = {}
    for name in ("thrust_constant", "torque_constant", "motor_time_constant"):
        quantities[name] = _quantity(
            name, [float(getattr(vehicle, name))], [logs[name]], _notes(name, weighed)
        )
    nominal = np.asarray(vehicle.inertia, float).tolist()
    low, high = YAW_INERTIA_RANGE
    inertia = _quantity(
        "inertia", nominal, [logs["roll"], logs["pitch"], (0.0, 0.0)], _notes("inertia", weighed)
    )
    pairs = (*inertia.interval90[:2], (low * nominal[2], high * nominal[2]))
    value = (*inertia.value[:2], nominal[2])
    quantities["inertia"] = dataclasses.replace(inertia, value=value, interval90=pairs)
    explained = _explained(fit)
    rates_fit = explained["body rates"][1] > LEAST_EXPLAINED
    untold = ["thrust_constant"] if fit.per_flight else []
    if not rates_fit:
        untold += ["torque_constant", "motor_time_constant", "inertia"]
    for name in untold:
        quantities[name] = dataclasses.replace(quantities[name], determined=False)
    cannot = []
    if fit.per_flight:
        scales = ", ".join(f"{fit.beta[i]:.3g}" for i in thrust)
        cannot.append(_UNKNOWN_MAP.format(scales=scales))
    if not weighed:
        cannot.append(_NOT_WEIGHED.format(grams=float(vehicle.mass) * 1e3))
    cannot.append(_YAW_CLASS)
    if not rates_fit:
        cannot.append(_NOT_EXPLAINED.format(share=max(explained["body rates"][1], 0.0)))
    for name, advice in _ADVICE.items():
        if name not in untold and not quantities[name].determined:
            cannot.append(f"{name.replace('_', ' ')}: these flights hardly excite it; {advice}")
    return Calibration(
        quantities=quantities,
        cannot_tell=tuple(cannot),
        nuisances=_nuisances(fit),
        explained=explained,
        flights=tuple(fit.flights),
        seconds=float(sum(len(t) * t.dt for t in fit.tracks)),
    )


def _quantity(name: str, nominal: list[float], logs: list[tuple[float, float]], notes: str) -> Quantity:
    logs = [(x, float(np.hypot(s, MODEL_ERROR[name]))) for x, s in logs]
    value = tuple(n * np.exp(x) for n, (x, _) in zip(nominal, logs, strict=True))
    pairs = tuple(
        (float(v * np.exp(-Z90 * s)), float(v * np.exp(Z90 * s)))
        for v, (_, s) in zip(value, logs, strict=True)
    )
    determined = all(s < DETERMINED for _, s in logs)
    return Quantity(
        tuple(map(float, value)), pairs, tuple(nominal), CALIBRATED_UNITS[name], determined, notes
    )


def _notes(name: str, weighed: bool) -> str:
    mass = "" if weighed else "for the assumed mass, which wasn't weighed"
    extra = {"inertia": "zz is assumed nominal", "torque_constant": "for the nominal inertia about z"}.get(
        name, ""
    )
    if name in ("motor_time_constant", "torque_constant"):
        mass = ""
    return "; ".join(n for n in (extra, mass) if n)


def _nuisances(fit: CalibrationFit) -> dict[str, tuple[float, str]]:
    units = {"clock": "s", "offset": "m", "drag": "1/s", "damping": "1/s", "tilt": "rad", "bias": "m/s^2"}
    return {
        name: (float(fit.beta[i]), units[name.partition("_")[0]])
        for i, name in enumerate(fit.names)
        if name.partition("_")[0] in units
    }


def _explained(fit: CalibrationFit) -> dict[str, tuple[float, float]]:
    """Per kind of channel: the share of its changes explained by the nominal vehicle and by the fitted
    one."""
    equations = fit.equations_at(fit.log_nominal)
    before = equations.y - equations.X @ fit.mean
    kinds = {"body rates": (0, 1, 2), "velocity": (3, 4, 5), "specific force": (6,)}
    logged = {
        kind: channels for kind, channels in kinds.items() if np.isin(equations.channel, channels).any()
    }
    return {
        kind: tuple(_share(fit, r, channels) for r in (before, fit.residual))
        for kind, channels in logged.items()
    }


def _share(fit: CalibrationFit, residual: np.ndarray, channels) -> float:
    """1 - mean square residual / variance of the channels' equations."""
    rows = np.isin(fit.equations.channel, channels)
    return float(1 - np.mean(residual[rows] ** 2) / np.var(fit.equations.y[rows]))

"""Calibration: the nominal vehicle's own constants from flights, with intervals and with what can't be told.

Gauss-Newton on the equations of `calibration_model`, nuisances free within weak priors. Residuals of real
flights are coloured, so errors come from blocks of time and from leaving flights out, never from counting
rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from openjax.errors import UserError
from openjax.gap.calibration_model import LAG_PRIOR, STEP, build, parameter_names, prior_of
from openjax.gap.flight import Case
from openjax.gap.track import Track, tracks_of
from openjax.vehicle.vehicle_file import CALIBRATED_UNITS, CalibratedValue

Z90 = 1.645
DETERMINED = 0.2  # standard deviation of the logarithm below which a quantity counts as determined
LEAST_EXPLAINED = 0.6  # share of the rates' changes; below, no constant that they tell can be trusted
YAW_INERTIA_RANGE = (0.7, 1.6)  # of nominal; what it may be where it is assumed
# Relative error (standard deviation) that remains however long one flies: commands and states are only known
# every 10 ms, the rotors' speed at half a millisecond of the simulator's step. Measured by closed loop, see
# the tests.
MODEL_ERROR = {
    "thrust_constant": 0.003,
    "torque_constant": 0.005,
    "motor_time_constant": 0.02,
    "inertia": 0.004,
}
_ITERATIONS = 8


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
    fit = _Fit(case, tracks, vehicles)
    fit.run()
    return _result(case, fit)


class _Fit:
    """The fit's working state: beta and log time constant, weights, covariance."""

    def __init__(self, case: Case, tracks: list[Track], vehicles):
        self.flights = list(dict.fromkeys(t.flight for t in tracks))
        self.per_flight = case.vehicle_file.motor_command == "pwm"
        self.names = parameter_names(self.flights, self.per_flight)
        self.mean, self.spread = prior_of(self.names)
        self.floor_z = float(case.vehicle_file.log.get("floor_z", 0.0))
        self.tracks, self.vehicles = tracks, vehicles
        self.log_nominal = float(np.log(vehicles[0].motor_time_constant))
        if not len(self._equations(self.log_nominal).y):
            raise UserError(
                f"{case.name}: no half second of flight is clear of the ground; nothing to calibrate on"
            )

    def _equations(self, log_lag: float):
        return build(self.tracks, self.vehicles, self.names, float(np.exp(log_lag)), self.floor_z)

    def run(self) -> None:
        beta, lag = self.mean.copy(), self.log_nominal
        sigma = None
        for _ in range(_ITERATIONS):
            equations, slope = self._linearised(lag, beta)
            sigma = self._noise(equations, equations.y - equations.X @ beta) if sigma is None else sigma
            beta, step = self._solve(equations, slope, sigma, lag, np.ones(len(equations.y), bool))
            moved = float(np.clip(lag + np.clip(step, -0.4, 0.4), np.log(2e-3), np.log(0.3)))
            sigma = self._noise(equations, equations.y - equations.X @ beta - slope * step)
            converged, lag = abs(moved - lag) < 1e-3, moved
            if converged:
                break
        self.equations, self.slope = self._linearised(lag, beta)
        self.beta, self.lag, self.sigma = beta, lag, sigma
        self.residual = self.equations.y - self.equations.X @ beta
        self.covariance = self._covariance()

    def _linearised(self, lag: float, beta: np.ndarray):
        later, earlier = self._equations(lag + STEP), self._equations(lag - STEP)
        return self._equations(lag), ((later.X - earlier.X) @ beta) / (2 * STEP)

    def _noise(self, equations, residual: np.ndarray) -> np.ndarray:
        """Per row: rms of the residual of its channel."""
        sigma = np.ones(len(residual))
        for channel in np.unique(equations.channel):
            rows = equations.channel == channel
            sigma[rows] = max(float(np.sqrt(np.mean(residual[rows] ** 2))), 1e-6)
        return sigma

    def _normal(self, equations, slope, sigma, lag: float, rows):
        """Weighted normal equations with the priors, for changes of (beta, log lag) about (prior mean,
        lag)."""
        G = np.column_stack([equations.X, slope])[rows] / sigma[rows, None]
        target = (equations.y - equations.X @ self.mean)[rows] / sigma[rows]
        precision = np.append(self.spread, LAG_PRIOR) ** -2.0
        right = G.T @ target
        right[-1] += precision[-1] * (self.log_nominal - lag)
        return G.T @ G + np.diag(precision), right, precision

    def _solve(self, equations, slope, sigma, lag: float, rows) -> tuple[np.ndarray, float]:
        hessian, right, _ = self._normal(equations, slope, sigma, lag, rows)
        solution = np.linalg.solve(hessian, right)
        return self.mean + solution[:-1], float(solution[-1])

    def _covariance(self) -> np.ndarray:
        """Of (beta, log lag), from blocks of time, widened where leaving flights out says more."""
        equations, sigma = self.equations, self.sigma
        every = np.ones(len(equations.y), bool)
        hessian, _, precision = self._normal(equations, self.slope, sigma, self.lag, every)
        scores = np.column_stack([equations.X, self.slope]) * (self.residual / sigma**2)[:, None]
        blocks = np.zeros((equations.block.max() + 1, scores.shape[1]))
        np.add.at(blocks, equations.block, scores)
        count = len(np.unique(equations.block))
        inverse = np.linalg.inv(hessian)
        meat = blocks.T @ blocks * count / max(count - 1, 1) + np.diag(precision)
        covariance = inverse @ meat @ inverse
        if len(self.flights) < 2:
            return covariance
        wider = np.sqrt(np.maximum(self._flight_variance() / np.diag(covariance), 1.0))
        return covariance * np.outer(wider, wider)

    def _flight_variance(self) -> np.ndarray:
        """Variance of (beta, log lag) over flights, by leaving each out. Flights tell different things, so
        each counts by its share of the information on a parameter: the delete-m_j jackknife (Busing, Meijer,
        van der Leeden 1999)."""
        equations, sigma = self.equations, self.sigma
        flights = np.unique(equations.flight)
        squares = (np.column_stack([equations.X, self.slope]) / sigma[:, None]) ** 2
        shares = np.stack([squares[equations.flight == f].sum(0) for f in flights])
        shares = np.clip(shares / np.maximum(shares.sum(0), 1e-12), 1e-6, 1 - 1e-6)
        left_out = []
        for flight in flights:
            beta, step = self._solve(equations, self.slope, sigma, self.lag, equations.flight != flight)
            left_out.append(np.append(beta, step))
        full = np.append(self.beta, 0.0)
        ratio = 1 / shares
        mean = len(flights) * full - ((1 - shares) * left_out).sum(0)
        pseudo = ratio * full - (ratio - 1) * left_out
        variance = np.mean((pseudo - mean) ** 2 / (ratio - 1), axis=0)
        own = np.array(
            [":" in n for n in (*self.names, "lag")]
        )  # one flight's own parameters don't vary over flights
        return np.where(own, 0.0, variance)


def _result(case: Case, fit: _Fit) -> Calibration:
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

    quantities, cannot = {}, []
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
    quantities["inertia"] = Quantity(
        (*inertia.value[:2], nominal[2]),
        pairs,
        inertia.nominal,
        inertia.unit,
        inertia.determined,
        inertia.notes,
    )
    if fit.per_flight:
        quantities["thrust_constant"] = _undetermined(quantities["thrust_constant"])
        scales = ", ".join(f"{np.round(fit.beta[i], 3):g}" for i in thrust)
        cannot.append(
            "the thrust constant: the commands are duty cycles whose map to thrust isn't known. Against the public map "
            f"the flights' thrust per assumed mass is {scales}; torques were scaled alike"
        )
    if not weighed:
        cannot.append(
            "mass against thrust: the mass wasn't weighed, so thrust and torque constants and inertia hold for the assumed "
            f"{float(vehicle.mass) * 1e3:.1f} g; a mass off by 1 % moves them all by 1 %. Weigh the vehicle"
        )
    cannot.append(
        "yaw torque constant against yaw inertia: only their ratio shows in yaw; the inertia is assumed nominal there"
    )
    explained = _explained(fit)
    rates_fit = explained["body rates"][1] > LEAST_EXPLAINED
    if not rates_fit:
        for name in ("torque_constant", "motor_time_constant", "inertia"):
            quantities[name] = _undetermined(quantities[name])
        cannot.append(
            f"inertia, torque constant, motor lag: motors explain only {max(explained['body rates'][1], 0.0):.0%} of what "
            "the gyroscope shows. Their clocks may disagree, or something else acts: run openjax.diagnose"
        )
    flown = {
        "thrust_constant": "climb and descend hard, or log the pose",
        "torque_constant": "turn left and right sharply",
        "motor_time_constant": "fly sharp changes of thrust or body rates, motors and IMU logged on one clock",
        "inertia": "roll and pitch sharply left and right",
    }
    for name, advice in flown.items():
        if (
            rates_fit
            and not quantities[name].determined
            and not (name == "thrust_constant" and fit.per_flight)
        ):
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


def _undetermined(q: Quantity) -> Quantity:
    return Quantity(q.value, q.interval90, q.nominal, q.unit, False, q.notes)


def _notes(name: str, weighed: bool) -> str:
    mass = "" if weighed else "for the assumed mass, which wasn't weighed"
    extra = {"inertia": "zz is assumed nominal", "torque_constant": "for the nominal inertia about z"}.get(
        name, ""
    )
    if name in ("motor_time_constant", "torque_constant"):
        mass = ""
    return "; ".join(n for n in (extra, mass) if n)


def _nuisances(fit: _Fit) -> dict[str, tuple[float, str]]:
    units = {"clock": "s", "offset": "m", "drag": "1/s", "damping": "1/s", "tilt": "rad", "bias": "m/s^2"}
    return {
        name: (float(fit.beta[i]), units[name.partition("_")[0]])
        for i, name in enumerate(fit.names)
        if name.partition("_")[0] in units
    }


def _explained(fit: _Fit) -> dict[str, tuple[float, float]]:
    """Per kind of channel: 1 - residual variance / variance, with the nominal vehicle and with the
    fitted one."""
    equations = fit._equations(fit.log_nominal)
    before = equations.y - equations.X @ fit.mean
    kinds = {"body rates": (0, 1, 2), "velocity": (3, 4, 5), "specific force": (6,)}
    shares = {}
    for kind, channels in kinds.items():
        rows = np.isin(equations.channel, channels)
        if rows.any():
            total = np.var(equations.y[rows])
            shares[kind] = tuple(float(1 - np.mean(r[rows] ** 2) / total) for r in (before, fit.residual))
    return shares

"""Frequency responses of a vehicle to its motors, without a model of it.

A high-order ARX fit of body rates (or of the force along body z) on the whole motor
signal in closed loop: Ljung, System Identification, chapters 4 and 13. Torques are
given as angular acceleration per unit of the motors' differential command, thrust as
specific force per unit of their mean. The nominal simulator is driven by the same rows
and read by the same estimator.
"""

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import Track
from openjax.gap.identification.prediction_errors import Problem, earlier, value_at
from openjax.gap.identification.regression import solve
from openjax.gap.identification.rotor_rows import rotor_rows
from openjax.gap.identification.row_errors import HALF_CYCLE
from openjax.gap.identification.search import TorqueFit, earliest

AXES = ("roll", "pitch", "yaw", "thrust")
FREQUENCIES = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 15.0])  # Hz
HIGHEST = 0.3  # of the rows' rate: above, rows say little
DRAWS = 200  # of the coefficients, for intervals
LEVEL = (5.0, 50.0, 95.0)  # per cent
GYROSCOPE = 0.02  # rad/s, noise of the simulated gyroscope
ACCELEROMETER = 0.15  # m/s^2, the same


@dataclass(frozen=True)
class Response:
    """One axis at `frequency` (F,) Hz: `gain` (F, 3), low, middle and high of 90 %, in
    rad/s^2 (or m/s^2 for thrust) per unit, `phase` (F, 3) degrees.
    """

    axis: str
    frequency: tuple[float, ...]
    gain: tuple[tuple[float, float, float], ...]
    phase: tuple[tuple[float, float, float], ...]

    def at(self, frequency: float) -> tuple[float, float]:
        """Gain and phase at the frequency next to one."""
        gain, phase = self.band_at(frequency)
        return gain[1], phase[1]

    def band_at(self, frequency: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Low, middle and high of gain and phase at the frequency next to one."""
        nearest = int(np.argmin(np.abs(np.array(self.frequency) - frequency)))
        return self.gain[nearest], self.phase[nearest]


@dataclass(frozen=True)
class Pair:
    """A response as measured, and as simulated with the nominal vehicle."""

    measured: Response
    simulated: Response


def responses(records: list[Track], fit: TorqueFit) -> dict[str, Pair]:
    """{axis: pair} of all axes that the records hold. `fit` gives the clock, and what a
    row of means does to its own end, which such rows can't tell from the loop's answer.
    """
    dt = records[0].dt
    too_late = earliest(records[0]) - fit.clock
    # motors that come earlier than need be would answer the noise of rates
    ahead = max(int(np.ceil((too_late - 0.5 * HALF_CYCLE) / dt)), 0)
    problem = Problem([earlier(r, ahead) for r in records])
    nominal = problem.start.copy()
    real = fit.value.copy()
    real[2] += ahead * dt
    if ahead:  # the rest of the way, which is the clock's and no vehicle's
        nominal[2] = max(real[2], 0.0)
    pairs = {}
    rng = np.random.default_rng(0)
    errors = problem.errors(nominal)
    rates_of_nominal = [
        _nominal_rates(r, error, rng) for r, (error, _) in zip(problem.records, errors, strict=True)
    ]
    for axis in range(3):
        rates = [r.body_rates[:, axis] for r in problem.records]
        replay = [s[:, axis] for s in rates_of_nominal]
        pairs[AXES[axis]] = Pair(
            _of_axis(problem, axis, rates, problem.at_once(real, axis)),
            _of_axis(problem, axis, replay, problem.at_once(value_at(nominal), axis)),
        )
    if all(r.specific_force is not None for r in records):
        pairs["thrust"] = _of_thrust(problem, rng)
    return pairs


def _nominal_rates(record: Track, error: np.ndarray, rng) -> np.ndarray:
    """Rates (T, 3) of the nominal vehicle, from what they leave of the record's, as a
    gyroscope shows them.
    """
    return record.body_rates - error + GYROSCOPE * rng.standard_normal(error.shape)


def _of_axis(problem: Problem, axis: int, outputs: list, at_once: float) -> Response:
    shares = [r.motor @ np.sign(problem.base[axis]) / 4.0 for r in problem.records]
    coefficients, covariance = _arx(
        problem, outputs, shares, at_once if problem.records[0].hides_ticks else None
    )
    return _response(AXES[axis], coefficients, covariance, problem.dt, derivative=True)


def _of_thrust(problem: Problem, rng) -> Pair:
    """Of the specific force along body z."""
    shares = [r.motor.mean(1) for r in problem.records]
    forces = [r.specific_force[:, 2] for r in problem.records]
    vehicle = problem.records[0].vehicle
    full = 4.0 * float(vehicle.thrust_constant * vehicle.max_rotor_speed**2 / vehicle.mass)
    lags = value_at(problem.start)[None, :3]
    nominal_forces = []
    for _, speed in rotor_rows([r.motor for r in problem.records], problem.dt, lags):
        # a row's speed is the one at its end, where the next row begins
        force = full * (np.concatenate([speed[0, :1], speed[0, :-1]]) ** 2).mean(1)
        nominal_forces.append(force + ACCELEROMETER * rng.standard_normal(len(force)))

    def of(outputs):
        coefficients, covariance = _arx(problem, outputs, shares, None)
        return _response("thrust", coefficients, covariance, problem.dt, False)

    return Pair(of(forces), of(nominal_forces))


def _windows(x: np.ndarray, order: int, first: int) -> np.ndarray:
    """Columns x(k), x(k - 1), ... (N, order) from row `first` on, for the row after."""
    rows = np.arange(first, len(x) - 1)
    return x[rows[:, None] - np.arange(order)]


def _arx(problem: Problem, outputs: list, inputs: list, at_once: float | None):
    """Coefficients (2 `order`,) on outputs and inputs before, and their covariance.
    With `at_once`, the effect of a row's input on its own end, what is new in the input
    is free beside it.
    """
    order = problem.order
    pasts = []
    nexts = []
    for number, (y, u) in enumerate(zip(outputs, inputs, strict=True)):
        output_columns = _windows(y, order, order)
        input_columns = _windows(u, order, order)
        ones = np.zeros((len(output_columns), len(outputs)))
        ones[:, number] = 1.0
        following = y[order + 1 :]
        if at_once is not None:
            past = np.concatenate([output_columns, _windows(u[:-1], order, order - 1), ones], 1)
            new = input_columns[:, 0] - past @ solve(past, input_columns[:, 0])
            following = following - at_once * input_columns[:, 0]
            input_columns = np.concatenate([input_columns[:, 1:], new[:, None]], 1)
        pasts.append(np.concatenate([output_columns, input_columns, ones], 1))
        nexts.append(following)
    past = np.concatenate(pasts)
    following = np.concatenate(nexts)
    solution = solve(past, following)
    errors = following - past @ solution
    covariance = np.linalg.pinv(past.T @ past) * errors.var()
    count = 2 * order
    coefficients = solution[:count].copy()
    covariance = covariance[:count, :count]
    if at_once is not None:
        # The last column is what was new, not a past input: the input's own comes
        # first.
        coefficients = np.concatenate([solution[:order], [at_once], solution[order : count - 1]])
        places = np.concatenate([np.arange(order), [count - 1], np.arange(order, count - 1)])
        covariance = covariance[np.ix_(places, places)]
        covariance[order] = covariance[:, order] = 0.0
    return coefficients, covariance


def _response(axis: str, coefficients, covariance, dt: float, derivative: bool) -> Response:
    frequency = FREQUENCIES[HIGHEST / dt >= FREQUENCIES]
    rng = np.random.default_rng(1)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = coefficients + rng.standard_normal((DRAWS, len(coefficients))) @ root.T
    order = len(coefficients) // 2
    turn = 2j * np.pi * frequency
    late = np.exp(-turn[:, None] * dt * np.arange(1, order + 1))
    transfer = (draws[:, order:] @ late.T) / (1.0 - draws[:, :order] @ late.T)
    hold = (1.0 - np.exp(-turn * dt)) / (turn * dt)
    transfer = transfer / hold * (turn if derivative else 1.0)
    middle = np.angle(np.median(transfer.real, 0) + 1j * np.median(transfer.imag, 0))
    phase = np.rad2deg(middle + np.angle(transfer * np.exp(-1j * middle)))
    gain = np.percentile(np.abs(transfer), LEVEL, axis=0).T
    phases = np.percentile(phase, LEVEL, axis=0).T
    return Response(
        axis,
        tuple(frequency.tolist()),
        tuple(map(tuple, gain.tolist())),
        tuple(map(tuple, phases.tolist())),
    )

"""Numbers of the vehicle's torques by prediction errors, in closed loop.

Body rates follow R = rates - model(parameters, motors) = noise of a high-order autoregression,
whose coefficients are concentrated out: the direct method of Ljung, System Identification, chapter
13, with a model of the ARARX kind. All of the motors' signal counts, as the loop has a delay.

Rows that are means over several cycles of the rate loop hide that delay: within a row motors
answer the gust that the row's end shows. So what is new in a row of motors, given everything
before, is free to act on the row's end (a control function: Wooldridge, Econometric Analysis of
Cross Section and Panel Data, chapter 6); the parameters are told by what could be foreseen. In
strong gusts that halves what a direct fit gets wrong of slow motors. Rows of quick ones stay off
by up to a sixth, which the intervals hold.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import butter, lfilter

from openjax.gap.identification.records import Record
from openjax.gap.identification.rotor_rows import rotor_rows

NAMES = (
    *("spin_up", "spin_down", "delay"),
    *("roll_gain", "pitch_gain", "yaw_gain"),
    *("damping", "yaw_damping", "propellers"),
)
"""s, s, s; torque per angular acceleration over the nominal one; 1/s; share of the inertia about
z."""
LOGARITHMS = [0, 1, 3, 4, 5]
"""Of these the search runs in the logarithm, so that none leaves what is possible."""
SPREAD = np.array([1.0, 1.0, 0.1, 0.7, 0.7, 0.7, 2.5, 2.5, 0.003])
"""Weak priors, several times the spread of such vehicles; logarithms where they are searched. Of
the damping twice what the rotors' inflow makes (.015 N s/m of thrust per climbing speed, on arms of
.03 m): a lag and a damping are two poles of one response, and nothing but their usual sizes says
which is which.
"""
UNEQUAL = 0.4  # spread of the logarithm of slowing down over speeding up
STEP = np.array([2e-4, 2e-4, 1e-4])  # s, of the difference quotients of lags
SEARCHED = np.array([[0.002, 0.15], [0.02, 5.0]])
"""Time constants, s, and gains beyond which nothing is looked for."""
EARLIEST = -0.002  # s, a cycle of the rate loop: when within it motors answer is convention
GYROSCOPE_FILTER = 80.0  # Hz, of second order: the Crazyflie's firmware, sensors_bmi088_bmp3xx.c
FAST_ROWS = 0.005  # s: slower rows show 2 ms of delay in its place
MEMORY = 0.25  # s of the noise's autoregression, within so many rows:
ROWS = (15, 50)
ITERATIONS = 25
LARGEST_STEP = np.array([0.8, 0.8, 0.01, 1.2, 1.2, 1.2, 8.0, 8.0, 0.003])
"""Of the search, in one step: logarithms, s, 1/s, share."""
LEAST_STEP = 0.003  # of that, at which a step that gains nothing isn't halved further
TINY = 1e-12  # rad^2/s^2: rates that never change
SMALL = 0.05  # nats that end the search
BLOCK = 1.0  # s over which errors may hang together
AHEAD = (0.01, 0.02, 0.04, 0.08)  # s by which motors are tried earlier than logged
LATE = (0.002, 0.03)  # s, starts of the delay
LAGS = (0.025, 0.07)  # s, starts of the lags
SWEEPS = 2
STRONG = 0.45  # of the nominal gain; the heaviest decks and duty cycles leave about as much
SOON = 0.12  # s; the slowest motors that fly
CLEARLY = 10.0  # nats by which motors logged too late must be better
FREE = 0.01  # s of rows whose surprise in the motors is free to act: the loop answers within them

HALF_CYCLE = 0.001  # s of the rate loop: when within one motors get their command is convention
NOISE_IN_GAIN = 35.0
NOISE_IN_LAG = 2.2
QUICK = 0.03  # s
"""What rows of means hide of a rate loop that answers noise weakens the response that they show.
Errors of gains, as logarithms, are so much over the square of what an axis turns in standard
deviations of its noise; errors of lags over that of what it turns within QUICK, beyond noise.
"""
LARGEST_ERROR = 2.0  # as a logarithm: nothing is known
LEAST_LAG = 0.03
LEAST_GAIN = 0.01
LEAST_DAMPING = 0.2
"""Errors of lags and gains, as logarithms, and of damping, 1/s, that such rows leave in still
air.
"""
SAMPLED_LAG = 0.3
SAMPLED_GAIN = 0.45
SAMPLED_DAMPING = 0.5  # 1/s
"""The same of single samples, which miss most of what the loop does. Root mean squares of simulated
flights in calm and gusty air, `experiments/results/identification.json`.
"""


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """`value` (9,) and `covariance` (9, 9) of `NAMES`; `loss` nats; `noise` {axis: coefficients
    (p,)}; `whole` innovations' variances (3,); `turning` (3,): what each axis turns, in standard
    deviations of its noise.
    """

    value: np.ndarray
    covariance: np.ndarray
    loss: float
    noise: list
    whole: np.ndarray
    turning: np.ndarray

    @property
    def clock(self) -> float:
        """s by which motors act later than logged."""
        return float(self.value[2])


def identify_torques(records: list[Record], one_clock: bool = True) -> TorqueFit:
    """The most likely fit of records with body rates, over the motors' clock as well; where streams
    share no `one_clock`, none is looked for.
    """
    base = Problem(records)
    first = base.fit(base.begin(LATE[0]))
    if base.dt < FAST_ROWS:
        # Whether such rows are of the filtered gyroscope nobody says, but they show it.
        filtered = Problem(records, filtered=True)
        other = filtered.fit(filtered.begin(LATE[0]))
        if other.loss < first.loss - CLEARLY:
            base, first = filtered, other
    if _clear(first) or not one_clock:
        return first
    fits = [first, base.fit(base.begin(LATE[1]))]
    for rows in {round(ahead / base.dt): None for ahead in AHEAD}:
        if rows:
            problem = Problem([earlier(r, rows) for r in records], base.filtered)
            fit = problem.fit(problem.begin(LATE[0]))
            value = fit.value.copy()
            value[2] -= rows * base.dt
            loss = _comparable(fit.loss, problem, base) + CLEARLY
            fits.append(replace(fit, value=value, loss=loss))
    return min(fits, key=lambda f: f.loss)


def _comparable(loss: float, problem: "Problem", base: "Problem") -> float:
    """A shifted log's loss as if it had as many rows as the whole one."""
    return (loss + problem.surprise) * base.count / problem.count - base.surprise


def _clear(fit: TorqueFit) -> bool:
    """Whether roll and pitch answer as strongly and as soon as those of any such vehicle: then the
    rows' clock is right to a few milliseconds, and no other need be tried.
    """
    return bool(fit.value[3:5].min() > STRONG and fit.value[:2].max() < SOON)


def earlier(record: Record, rows: int) -> Record:
    """The record as if its motors had acted `rows` earlier than logged."""
    count = len(record.rates) - rows
    return replace(record.rows(slice(0, count)), motor=record.motor[rows:])


def _lagged(x: np.ndarray, order: int) -> np.ndarray:
    """x(k), then differences x(k) - x(k - 1) and before, (T - order, order): rows k = order - 1 up
    to T - 2, which foretell the next.
    """
    windows = sliding_window_view(x, order)[:-1, ::-1]
    return np.concatenate([windows[:, :1], windows[:, :-1] - windows[:, 1:]], 1)


class Problem:
    """Records with all that doesn't depend on the parameters. `filtered`: rates went through the
    firmware's filter of the gyroscope.
    """

    def __init__(self, records: list[Record], filtered: bool = False):
        self.records = records
        self.dt = records[0].dt
        self.filtered = filtered
        self.order = int(np.clip(round(MEMORY / self.dt), *ROWS))
        vehicle = records[0].vehicle
        self.inertia = np.asarray(vehicle.inertia, float)
        thrust = float(vehicle.thrust_constant) * float(vehicle.max_rotor_speed) ** 2
        x, y = np.asarray(vehicle.rotor_position, float)[:, :2].T
        self.spin = np.asarray(vehicle.rotor_spin, float)
        reaction = float(vehicle.torque_constant / vehicle.thrust_constant) * self.spin
        self.base = thrust * np.stack([y, -x, reaction]) / self.inertia[:, None]
        self.top_speed = float(vehicle.max_rotor_speed)
        up = float(vehicle.motor_time_constant)
        down = up * float(vehicle.motor_slowdown_ratio)
        self.start = np.array([np.log(up), np.log(down), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        self.precision = np.diag(SPREAD**-2.0)
        self.precision[:2, :2] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / UNEQUAL**2
        self.new = [self._new(r) if r.hidden else None for r in records]
        self.count = sum(len(r.rates) - self.order - 1 for r in records)
        self.surprise = 0.0
        if records[0].hidden:
            every = np.concatenate(self.new)
            self.surprise = 0.5 * len(every) * float(np.log(every.var(0) + TINY).sum())

    def _new(self, record: Record) -> np.ndarray:
        """(T - order - 1, 3) what is new in the motors' shares of each axis in the rows from
        `order` on, given rates until then and motors before.
        """
        shares = record.motor @ np.sign(self.base).T / 4.0
        out = []
        for axis in range(3):
            rates = _lagged(record.rates[1:, axis], self.order)
            before = _lagged(shares[:-1, axis], self.order)
            past = np.concatenate([rates, before, np.ones((len(rates), 1))], 1)
            present = shares[self.order : -1, axis]
            out.append(present - past @ solve(past, present))
        return np.stack(out, 1)

    def modelled(self, place: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each record its rates less the model's (T, 3) at a place (9,) of the search, and their
        derivatives (9, T, 3).
        """
        value = _value(place)
        lags = np.repeat(value[None, :3], 4, 0)
        lags[[1, 2, 3], [0, 1, 2]] += STEP
        rotors = rotor_rows([r.motor for r in self.records], self.dt, lags)
        both = zip(self.records, rotors, strict=True)
        return [self._left(value, record.rates, *rotor) for record, rotor in both]

    def _left(self, value: np.ndarray, rates: np.ndarray, square: np.ndarray, speed: np.ndarray):
        """`modelled` of one record, whose rotors turned so."""
        unit = square @ self.base.T
        sped = self.top_speed * np.diff(speed, axis=1, prepend=speed[:, :1]) @ self.spin
        gyroscopic = np.cross(rates, self.inertia * rates) / self.inertia
        gains = value[3:6]
        damping = value[[6, 6, 7]]
        grown = self.dt * (gains * unit - damping * rates - gyroscopic)
        grown[..., 2] += value[8] * sped
        slope = np.zeros((len(NAMES), *rates.shape))
        slope[:3] = (grown[1:] - grown[0]) / STEP[:, None, None]
        slope[[3, 4, 5], :, [0, 1, 2]] = self.dt * unit[0].T
        slope[6, :, :2] = -self.dt * rates[:, :2]
        slope[7, :, 2] = -self.dt * rates[:, 2]
        slope[8, :, 2] = sped[0]

        def whole(rows):
            return np.cumsum(rows, -2) - rows

        slope[LOGARITHMS] *= value[LOGARITHMS, None, None]
        model = whole(grown[0])
        slope = whole(slope)
        if self.filtered:
            low = butter(2, GYROSCOPE_FILTER, fs=1.0 / self.dt)
            model = lfilter(*low, model, axis=0)
            slope = lfilter(*low, slope, axis=1)
        return rates - model, slope

    @staticmethod
    def values(place: np.ndarray) -> np.ndarray:
        """The parameters (9,) at a place of the search."""
        return _value(place)

    def at_once(self, value: np.ndarray, axis: int) -> float:
        """rad/s at a row's end per unit of an axis' motors in the row itself: what a delay and a
        lag leave of it, for parameters (9,).
        """
        lag = value[:2].mean()
        acts = max(self.dt - value[2], 0.0)
        effect = acts - lag * (1.0 - np.exp(-acts / lag))
        return float(value[3 + axis] * np.abs(self.base[axis]).sum() * effect)

    def solve(self, value: np.ndarray) -> tuple[float, list]:
        """Loss at a place (9,) of the search, and of each axis: innovations (N,), their derivatives
        (N, 9) less what the noise model takes, and its coefficients.
        """
        modelled = self.modelled(value)
        axes = [self._axis(axis, modelled) for axis in range(3)]
        off = value - self.start
        loss = 0.5 * off @ self.precision @ off
        loss += sum(0.5 * len(e) * np.log(e.var() + TINY) for e, _, _ in axes)
        return float(loss), axes

    def _axis(self, axis: int, modelled: list):
        order = self.order
        steady = 2 * len(modelled)
        pasts = []
        nexts = []
        for number, (left, _) in enumerate(modelled):
            x = left[:, axis]
            line = np.stack([np.ones(len(x)), np.linspace(-1.0, 1.0, len(x))], 1)
            x = x - line @ solve(line, x)
            flat = np.zeros((len(x) - order - 1, steady))
            flat[:, 2 * number : 2 * number + 2] = line[order + 1 :]
            parts = [_lagged(x, order)[1:], flat]
            if self.new[number] is not None:
                parts += self._answers(self.new[number][:, axis])
            pasts.append(np.concatenate(parts, 1))
            nexts.append(x[order + 1 :])
        past = np.concatenate(pasts)
        following = np.concatenate(nexts)
        regression = Regression(past)
        taken = regression.solve(following)
        errors = following - past @ taken
        whitening = _polynomial(taken[:order])
        slopes = [-lfilter(whitening, [1.0], s[:, :, axis], axis=1) for _, s in modelled]
        slopes = np.concatenate([s[:, order + 1 :] for s in slopes], 1).T
        return errors, slopes - past @ regression.solve(slopes), taken[:order]

    def turning(self, axes: list) -> tuple[np.ndarray, np.ndarray]:
        """What each axis (3,) turns, and what it turns within QUICK, in standard deviations of its
        noise.
        """
        noise = np.array([e.var() for e, _, _ in axes]) + TINY
        rows = max(round(QUICK / self.dt), 1)
        whole = np.concatenate([r.rates for r in self.records])
        quick = np.concatenate([r.rates[rows:] - r.rates[:-rows] for r in self.records])
        return np.sqrt(whole.var(0) / noise), np.sqrt(0.5 * quick.var(0) / noise)

    def _hidden(self, axes: list) -> np.ndarray:
        """Standard deviations (9,) at a place of the search, of what rows hide."""
        out = np.zeros(len(NAMES))
        out[2] = HALF_CYCLE
        if not self.records[0].hidden:
            return out
        if any(r.samples for r in self.records):
            out[[0, 1]] = SAMPLED_LAG
            out[[3, 4, 5]] = SAMPLED_GAIN
            out[[6, 7]] = SAMPLED_DAMPING
            return out
        turned, quick = self.turning(axes)
        beyond = max(quick[:2].max() ** 2 - 1.0, NOISE_IN_LAG / LARGEST_ERROR)
        out[[0, 1]] = np.hypot(LEAST_LAG, NOISE_IN_LAG / beyond)
        gain = np.minimum(NOISE_IN_GAIN / turned**2, LARGEST_ERROR)
        out[[3, 4, 5]] = np.hypot(LEAST_GAIN, gain)
        out[[6, 7]] = LEAST_DAMPING
        return out

    def _answers(self, new: np.ndarray) -> list[np.ndarray]:
        """Columns (N, 1) of what was new in the last rows of motors; before the first nothing."""
        free = max(round(FREE / self.dt), 1)
        return [
            np.concatenate([np.zeros(row), new[: len(new) - row]])[:, None] for row in range(free)
        ]

    def begin(self, late: float) -> np.ndarray:
        """A place (9,) to search from, with motors `late` s: of some lags that of the least loss,
        once gains, in which the model is linear, are fitted to it.
        """
        begun = []
        for lag in LAGS:
            place = self.start.copy()
            place[:3] = np.log(lag), np.log(lag), late
            for _ in range(SWEEPS):
                place = self._swept(place)
            begun.append((self.solve(place)[0], place))
        return min(begun, key=lambda b: b[0])[1]

    def _swept(self, place: np.ndarray) -> np.ndarray:
        """The place with gains as of least squares, for the noise as it is."""
        gains = np.exp(place[3:6])
        _, axes = self.solve(place)
        hessian = self.precision[3:6, 3:6] / gains**2
        push = np.zeros(3)
        for errors, slopes, _ in axes:
            linear = slopes[:, 3:6] / gains
            hessian += linear.T @ linear / (errors.var() + TINY)
            push += linear.T @ errors / (errors.var() + TINY)
        found = gains - np.linalg.solve(hessian, push)
        out = place.copy()
        out[3:6] = np.log(np.maximum(found, SEARCHED[1][0]))
        return self._bounded(out)

    def fit(self, place: np.ndarray) -> TorqueFit:
        """Gauss-Newton from a place (9,), in steps no larger than its linearisation is good for."""
        value = place
        loss, axes = self.solve(value)
        for _ in range(ITERATIONS):
            step = self._step(value, axes)
            while True:
                ahead = self._bounded(value + step)
                reached, there = self.solve(ahead)
                if reached < loss or np.abs(step / LARGEST_STEP).max() < LEAST_STEP:
                    break
                step = 0.3 * step
            gained = loss - reached
            if gained <= 0.0:
                break
            value, loss, axes = ahead, reached, there
            if gained < SMALL:
                break
        scale = np.ones(len(value))
        scale[LOGARITHMS] = _value(value)[LOGARITHMS]
        return TorqueFit(
            _value(value),
            (self._covariance(value, axes) + np.diag(self._hidden(axes) ** 2))
            * np.outer(scale, scale),
            loss,
            [a[2] for a in axes],
            np.array([a[0].var() for a in axes]),
            self.turning(axes)[0],
        )

    def _step(self, value: np.ndarray, axes: list) -> np.ndarray:
        """Gauss-Newton's step (9,), of at most LARGEST_STEP; what stands at a bound and is pushed
        beyond stays.
        """
        hessian, push = self._normal(value, axes)
        tried = self._bounded(value - 1e-6 * np.sign(push))
        free = np.flatnonzero(tried != value)
        step = np.zeros(len(value))
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], -push[free])
        return step / max(np.abs(step / LARGEST_STEP).max(), 1.0)

    def _bounded(self, value: np.ndarray) -> np.ndarray:
        out = value.copy()
        out[:2] = np.clip(out[:2], *np.log(SEARCHED[0]))
        out[2] = max(out[2], EARLIEST if self.records[0].hidden else 0.0)
        out[3:6] = np.clip(out[3:6], *np.log(SEARCHED[1]))
        return out

    def _normal(self, value, axes):
        hessian = self.precision.copy()
        push = self.precision @ (value - self.start)
        for errors, slopes, _ in axes:
            hessian += slopes.T @ slopes / (errors.var() + TINY)
            push += slopes.T @ errors / (errors.var() + TINY)
        return hessian, push

    def _covariance(self, value, axes) -> np.ndarray:
        """Of the parameters, widened where errors hang together over seconds (a sandwich's)."""
        hessian, _ = self._normal(value, axes)
        inverse = np.linalg.inv(hessian)
        scores = np.zeros_like(hessian)
        for errors, slopes, _ in axes:
            pieces = np.arange(0, len(errors), max(int(BLOCK / self.dt), 1))
            sums = np.add.reduceat(slopes * errors[:, None], pieces, 0) / (errors.var() + TINY)
            scores += sums.T @ sums
        wider = np.trace(scores @ inverse) / len(hessian)
        return inverse * max(1.0, wider)


def _value(place: np.ndarray) -> np.ndarray:
    """The parameters (9,) at a place of the search."""
    out = place.copy()
    out[LOGARITHMS] = np.exp(place[LOGARITHMS])
    return out


def _polynomial(taken: np.ndarray) -> np.ndarray:
    """1 - a_1 q^-1 - ... of coefficients on the last value and on differences before it."""
    out = np.zeros(len(taken) + 1)
    out[0] = 1.0
    out[1] -= taken[0]
    out[1:-1] -= taken[1:]
    out[2:] += taken[1:]
    return out


class Regression:
    """Least squares on columns (N, P), by normal equations of scaled columns."""

    def __init__(self, columns: np.ndarray):
        gram = columns.T @ columns
        self.columns = columns
        self.scale = np.sqrt(np.diag(gram)) + 1e-30
        self.gram = gram / np.outer(self.scale, self.scale)
        self.gram[np.diag_indices(len(gram))] += 1e-10

    def solve(self, target: np.ndarray) -> np.ndarray:
        """Coefficients (P, ...) of targets (N, ...)."""
        products = (self.columns.T @ target).T / self.scale
        return (np.linalg.solve(self.gram, products.T).T / self.scale).T


def solve(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Least squares coefficients (P, ...) of columns (N, P) for targets (N, ...)."""
    return Regression(columns).solve(target)

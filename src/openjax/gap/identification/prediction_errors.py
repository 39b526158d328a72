"""Numbers of the vehicle's torques by prediction errors, in closed loop.

Body rates follow R = rates - model(parameters, motors) = noise of a high-order
autoregression, whose coefficients are concentrated out: the direct method of Ljung,
System Identification, chapter 13, with a model of the ARARX kind. All of the motors'
signal counts, as the loop has a delay.

Rows that are means over several cycles of the rate loop hide that delay: within a row
motors answer the gust that the row's end shows. So what is new in a row of motors,
given everything before, is free to act on the row's end (a control function:
Wooldridge, Econometric Analysis of Cross Section and Panel Data, chapter 6); the
parameters are told by what could be foreseen. In strong gusts that halves what a direct
fit gets wrong of slow motors. Rows of quick ones stay off by up to a sixth, which the
intervals hold.
"""

from dataclasses import replace

import numpy as np
from scipy.signal import butter, lfilter

from openjax.flights.track import Track
from openjax.gap.identification.regression import Regression, lag_columns, polynomial, solve
from openjax.gap.identification.rotor_rows import rotor_rows

NAMES = (
    *("spin_up", "spin_down", "delay"),
    *("roll_gain", "pitch_gain", "yaw_gain"),
    *("damping", "yaw_damping", "propellers"),
)
"""s, s, s; torque per angular acceleration over the nominal one; 1/s; share of the
inertia about z.
"""
LOGARITHMS = [0, 1, 3, 4, 5]
"""Of these the search runs in the logarithm, so that none leaves what is possible."""
SPREAD = np.array([1.0, 1.0, 0.1, 0.7, 0.7, 0.7, 2.5, 2.5, 0.003])
"""Weak priors, several times the spread of such vehicles; logarithms where they are
searched. Of the damping twice what the rotors' inflow makes (.015 N s/m of thrust per
climbing speed, on arms of .03 m): a lag and a damping are two poles of one response,
and nothing but their usual sizes says which is which.
"""
UNEQUAL = 0.4  # spread of the logarithm of slowing down over speeding up
STEP = np.array([2e-4, 2e-4, 1e-4])  # s, of the difference quotients of lags
# Hz, of second order: the Crazyflie's firmware, sensors_bmi088_bmp3xx.c
GYROSCOPE_FILTER = 80.0
MEMORY = 0.25  # s of the noise's autoregression, within so many rows:
ROWS = (15, 50)
TINY = 1e-12  # rad^2/s^2: rates that never change
# s of rows whose surprise in the motors is free to act: the loop answers within them
FREE = 0.01


def earlier(record: Track, rows: int) -> Track:
    """The record as if its motors had acted `rows` earlier than logged."""
    count = len(record) - rows
    return replace(record.rows(slice(0, count)), motor=record.motor[rows:])


class Problem:
    """Records with all that doesn't depend on the parameters. `low_pass`: rates went
    through the firmware's filter of the gyroscope.
    """

    def __init__(self, records: list[Track], low_pass: bool = False):
        self.records = records
        self.dt = records[0].dt
        self.low_pass = low_pass
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
        self.new = [self._new(r) if r.hides_ticks else None for r in records]
        self.count = sum(len(r) - self.order - 1 for r in records)
        self.surprise = 0.0
        if records[0].hides_ticks:
            every = np.concatenate(self.new)
            self.surprise = 0.5 * len(every) * float(np.log(every.var(0) + TINY).sum())

    def _new(self, record: Track) -> np.ndarray:
        """(T - order - 1, 3) what is new in the motors' shares of each axis in the rows
        from `order` on, given rates until then and motors before.
        """
        shares = record.motor @ np.sign(self.base).T / 4.0
        out = []
        for axis in range(3):
            rates = lag_columns(record.body_rates[1:, axis], self.order)
            motors = lag_columns(shares[:-1, axis], self.order)
            past = np.concatenate([rates, motors, np.ones((len(rates), 1))], 1)
            present = shares[self.order : -1, axis]
            out.append(present - past @ solve(past, present))
        return np.stack(out, 1)

    def errors(self, place: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each record its rates less the model's (T, 3) at a place (9,) of the
        search, and their derivatives (9, T, 3).
        """
        value = value_at(place)
        lags = np.repeat(value[None, :3], 4, 0)
        lags[[1, 2, 3], [0, 1, 2]] += STEP
        rotors = rotor_rows([r.motor for r in self.records], self.dt, lags)
        both = zip(self.records, rotors, strict=True)
        return [
            self._errors_of(value, record.body_rates, square, speed)
            for record, (square, speed) in both
        ]

    def _errors_of(
        self, value: np.ndarray, rates: np.ndarray, square: np.ndarray, speed: np.ndarray
    ):
        """`errors` of one record, whose rotors turned so."""
        unit = square @ self.base.T
        acceleration = self.top_speed * np.diff(speed, axis=1, prepend=speed[:, :1]) @ self.spin
        gyroscopic = np.cross(rates, self.inertia * rates) / self.inertia
        gains = value[3:6]
        damping = value[[6, 6, 7]]
        increments = self.dt * (gains * unit - damping * rates - gyroscopic)
        increments[..., 2] += value[8] * acceleration
        slope = np.zeros((len(NAMES), *rates.shape))
        slope[:3] = (increments[1:] - increments[0]) / STEP[:, None, None]
        slope[[3, 4, 5], :, [0, 1, 2]] = self.dt * unit[0].T
        slope[6, :, :2] = -self.dt * rates[:, :2]
        slope[7, :, 2] = -self.dt * rates[:, 2]
        slope[8, :, 2] = acceleration[0]

        def whole(rows):
            return np.cumsum(rows, -2) - rows

        slope[LOGARITHMS] *= value[LOGARITHMS, None, None]
        model = whole(increments[0])
        slope = whole(slope)
        if self.low_pass:
            low = butter(2, GYROSCOPE_FILTER, fs=1.0 / self.dt)
            model = lfilter(*low, model, axis=0)
            slope = lfilter(*low, slope, axis=1)
        return rates - model, slope

    def at_once(self, value: np.ndarray, axis: int) -> float:
        """rad/s at a row's end per unit of an axis' motors in the row itself: what a
        delay and a lag leave of it, for parameters (9,).
        """
        lag = value[:2].mean()
        acts = max(self.dt - value[2], 0.0)
        effect = acts - lag * (1.0 - np.exp(-acts / lag))
        return float(value[3 + axis] * np.abs(self.base[axis]).sum() * effect)

    def solve(self, value: np.ndarray) -> tuple[float, list]:
        """Loss at a place (9,) of the search, and of each axis: innovations (N,), their
        derivatives (N, 9) less what the noise model takes, and its coefficients.
        """
        errors = self.errors(value)
        axes = [self._axis(axis, errors) for axis in range(3)]
        off = value - self.start
        loss = 0.5 * off @ self.precision @ off
        loss += sum(0.5 * len(e) * np.log(e.var() + TINY) for e, _, _ in axes)
        return float(loss), axes

    def _axis(self, axis: int, errors_of_records: list):
        order = self.order
        steady = 2 * len(errors_of_records)
        pasts = []
        nexts = []
        for number, (errors_of_record, _) in enumerate(errors_of_records):
            x = errors_of_record[:, axis]
            # how the body turned at first, and what turns it steadily, add a line to
            # the rates of a model that knows neither
            line = np.stack([np.ones(len(x)), np.linspace(-1.0, 1.0, len(x))], 1)
            x = x - line @ solve(line, x)
            flat = np.zeros((len(x) - order - 1, steady))
            flat[:, 2 * number : 2 * number + 2] = line[order + 1 :]
            parts = [lag_columns(x, order)[1:], flat]
            if self.new[number] is not None:
                parts += self._answers(self.new[number][:, axis])
            pasts.append(np.concatenate(parts, 1))
            nexts.append(x[order + 1 :])
        past = np.concatenate(pasts)
        following = np.concatenate(nexts)
        regression = Regression(past)
        coefficients = regression.solve(following)
        errors = following - past @ coefficients
        whitening = polynomial(coefficients[:order])
        slopes = [-lfilter(whitening, [1.0], s[:, :, axis], axis=1) for _, s in errors_of_records]
        slopes = np.concatenate([s[:, order + 1 :] for s in slopes], 1).T
        return errors, slopes - past @ regression.solve(slopes), coefficients[:order]

    def _answers(self, new: np.ndarray) -> list[np.ndarray]:
        """Columns (N, 1) of what was new in the last rows of motors; before the first
        nothing.
        """
        free = max(round(FREE / self.dt), 1)
        return [
            np.concatenate([np.zeros(row), new[: len(new) - row]])[:, None] for row in range(free)
        ]


def value_at(place: np.ndarray) -> np.ndarray:
    """The parameters (9,) at a place of the search."""
    out = place.copy()
    out[LOGARITHMS] = np.exp(place[LOGARITHMS])
    return out

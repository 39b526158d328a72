"""The rate loop: its gains, read from what commands excite.

What the motors differ by is the rate controller's output. In closed loop it answers noise and gusts, so the gains are read by
the generalised method of moments (Hansen 1982), with what the nominal loop would have done under the same commands as
instruments: neither colour nor clocks need a model. An observer runs the same loop for the motor command of every tick."""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.signal import butter, detrend, sosfiltfilt
from scipy.stats import norm
from scipy.stats import t as student

from openjax.flights.track import Track, smooth
from openjax.gap.channels import Channel, Estimated, effects_of
from openjax.gap.channels.instruments import BAND, COUNT, EDGE, in_force, outputs_of
from openjax.gap.decision import DECISION
from openjax.gap.model.observer import GYRO_GAIN, observe
from openjax.gap.model.prediction import bucket, padded
from openjax.vehicle.rate_controller import mixer

GAIN_STEP = 0.05
PRIOR = np.array([0.4, 0.4, 0.4, 1.0, 1.0])  # spreads of the gains and of the delays of P and D
FILTER_DELAY = 0.004  # s, usual size of what low-passes do to the derivative
# s by which motors may be off, where rows are the log's own and where they are means of its rows.
ROW_DELAY = (0.0005, 0.0025)
MARGIN = 0.05  # of a motor command: nearer to its limits some tick of the row was cut
SEGMENT = 0.5  # s, unit of the errors
LEAST_SECONDS = 6  # without a motor at its limit
SMOOTH = 0.05  # s over which the outputs are compared
GAINS = ("p", "i", "d")


@dataclass(frozen=True, eq=False)
class RateLoop(Channel):
    """`change` (6,) and `error` (6,) of p, i, d as shares, roll and pitch first and then yaw; `outputs` [(T, 3)]: logged less
    nominal outputs of each track; `tied` [(3, T, 3)]: what one more of p, i, d would give; `ticks` [(T, TICKS, 4)]: the motor
    commands of the rate loop's ticks; `names`: the effects that it tells."""

    change: np.ndarray
    error: np.ndarray
    outputs: list[np.ndarray]
    tied: list[np.ndarray]
    ticks: list[np.ndarray]
    names: tuple[str, ...]
    dt: float = 0.01
    path = "rate_loop"

    @cached_property
    def gain(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes (3,) of p, i, d and their errors, of roll, pitch and yaw together: by their precision, with an error that
        covers what the two disagree by (Birge 1932)."""
        value, error = self.change.reshape(2, 3), self.error.reshape(2, 3)
        weight = 1.0 / np.maximum(error, 1e-9) ** 2
        total = np.maximum(weight.sum(0), 1e-12)
        mean = (weight * value).sum(0) / total
        apart = np.sqrt((weight * (value - mean) ** 2).sum(0))
        return mean, np.maximum(apart, 1.0) / np.sqrt(total)

    def acting(self) -> dict[str, float]:
        """Either group of axes may be retuned alone: the surer one tells. Gains that don't predict the motors better by as
        much as they must differ aren't read from a rate loop like ours."""
        squares = [
            np.array([np.mean(np.concatenate(v) ** 2) for v in self.residuals(named).values()])
            for named in ((), self.names)
        ]
        if np.sqrt((squares[0] / squares[1]).mean()) < 1.0 + DECISION.rate_gain:
            return {}
        change, error = np.abs(self.change[[0, 3]]), self.error[[0, 3]]
        told = change > DECISION.standard_errors * error
        chance = norm.cdf((change - DECISION.rate_gain) / error) * told * (1.0 - DECISION.unknown)
        return {e: float(chance.max()) for e in self.names if chance.max() > 0.5}

    def undetectable(self) -> list[str]:
        return [] if self.error[[0, 3]].min() < DECISION.rate_gain else list(self.names)

    def estimate(self, effect: str, parameter: str) -> Estimated:
        place = GAINS.index(parameter)
        change, error = (float(v[place]) for v in self.gain)
        return Estimated(1.0 + change, error, error)

    def residuals(self, named) -> dict[str, list[np.ndarray]]:
        changed = self.gain[0] if set(named) & set(self.names) else np.zeros(3)
        out: dict[str, list[np.ndarray]] = {f"motors {axis}": [] for axis in ("roll", "pitch", "yaw")}
        for outputs, tied in zip(self.outputs, self.tied, strict=True):
            left = detrend(outputs - np.tensordot(changed, tied, 1), axis=0)
            for column, series in zip(left.T, out.values(), strict=True):
                series.append(smooth(column, SMOOTH, self.dt))
        return out


def read_rate_loop(reading) -> RateLoop:
    """Read the rate controllers of all tracks of a `motion.Reading`."""
    gains = (1.0 + np.concatenate([np.zeros((1, 3)), GAIN_STEP * np.eye(3)])).astype(np.float32)
    outputs, tied, ticks = [], [], []
    for track, vehicle, link in zip(reading.tracks, reading.vehicles, reading.arrived, strict=True):
        wanted, sent = observed(track, vehicle, link, gains, reading.at_once)
        ticks.append(sent)
        demand = wanted @ outputs_of(vehicle)
        outputs.append(track.motor @ outputs_of(vehicle) - demand[0])
        tied.append((demand[1:] - demand[0]) / GAIN_STEP)
    change, error = read_gains(reading)
    names = effects_of("rate_loop", reading.library)
    return RateLoop(change, error, outputs, tied, ticks, names, max(t.dt for t in reading.tracks))


def with_motors(track: Track, vehicle) -> Track:
    """The track with motor commands: where they weren't logged, those that the nominal rate controller
    would send."""
    if track.motor is not None:
        return track
    rows = np.arange(len(track))
    link = (0.0, np.stack([rows, np.maximum(rows - 1, 0)], 1))
    track = dataclasses.replace(track, motor=np.repeat(track.command[:, :1], 4, 1))
    gains = np.ones((1, 3), np.float32)
    for _ in range(2):
        wanted, _ = observed(track, vehicle, link, gains)
        track = dataclasses.replace(track, motor=wanted[0], motors_logged=False)
    return track


def observed(track: Track, vehicle, link, gains, at_once=False):
    """The observer's output: mean motor commands wanted (B, T, 4), and the commands sent in the ticks (T, TICKS, 4) with the
    first gains.

    What pushed the body beyond the nominal physics in a first run is given to a second, so that the rates
    inside a row are right whatever the physics."""
    rows, size = len(track), bucket(len(track))
    inputs = [padded(v, size) for v in (in_force(track, link), track.motor, track.body_rates)]
    push = padded(np.zeros((rows, 3)), size)
    for _ in range(2):
        wanted, sent, rates = observe(gains, vehicle, *inputs, push, np.float32(track.dt), at_once)
        miss = track.body_rates[1:] - np.asarray(rates[0], float)[: rows - 1]
        step = miss.copy()  # undo the observer's own correction of what it missed before
        step[1:] -= (1.0 - GYRO_GAIN) * miss[:-1]
        push = push + padded(smooth(np.concatenate([step, step[-1:]]), 0.06, track.dt) / track.dt, size)
    return np.asarray(wanted, float)[:, :rows], np.asarray(sent[0])[:rows]


def read_gains(reading) -> tuple[np.ndarray, np.ndarray]:
    """Changes (6,) of p, i, d as shares - roll and pitch, then yaw - and their errors, infinite where flights say too little."""
    change, error = np.zeros(6), np.full(6, np.inf)
    if reading.late is None:
        return change, error
    moments: dict[int, list] = {0: [], 1: [], 2: []}  # axis: [(moments (5, 1 + 5), track)] of every segment
    by_track = zip(reading.tracks, reading.vehicles, reading.arrived, reading.by_commands, strict=True)
    for unit, own in enumerate(by_track):
        for axis, part in _segments(*own, reading.at_once, reading.late):
            moments[axis].append((part, unit))
    for group, axes in enumerate(((0, 1), (2,))):
        found = np.array([m for a in axes for m, _ in moments[a]])
        units = np.array([(a, u) for a in axes for _, u in moments[a]])
        if len(found) * SEGMENT < LEAST_SECONDS * len(axes):
            continue
        theta, spread = _moments(found)
        own = slice(3 * group, 3 * group + 3)
        change[own], error[own] = theta[:3], np.maximum(spread, _between(found, units, theta))[:3]
    return change, error


def _segments(track: Track, vehicle, link, by_commands, at_once: bool, late: float):
    """(axis, moments (5, 1 + 5)) of every segment without a motor at its limit: of instruments with outputs and regressors."""
    _, drawn = by_commands
    ruling, rates = in_force(track, link), track.body_rates
    sent = ruling[:, 0, 1:] if at_once else ruling[..., 1:].mean(1)
    after = np.concatenate([rates[1:], rates[-1:]])
    slope = (after - rates) / track.dt
    if at_once:
        slope = 0.5 * (slope + np.concatenate([slope[:1], slope[:-1]]))
    gain = [np.asarray(getattr(vehicle, n), float) * COUNT for n in ("rate_kp", "rate_ki", "rate_kd")]

    def tied(rates, slope):
        error = sent - rates
        return np.stack([gain[0] * error, gain[1] * np.cumsum(error, 0) * track.dt, -gain[2] * slope])

    x, z = (
        tied(rates if at_once else 0.5 * (rates + after), slope),
        tied(drawn, np.gradient(drawn, track.dt, axis=0)),
    )
    y = track.motor @ outputs_of(vehicle) - x.sum(0)
    edge, size = int(EDGE / track.dt), max(int(SEGMENT / track.dt), 1)
    if len(track) < 4 * edge + size:
        return
    times = np.array([late, FILTER_DELAY])[:, None, None]
    delayed = [times * np.gradient(v[[0, 2]], track.dt, axis=1) for v in (x, z)]
    band = butter(2, (BAND[0], min(BAND[1], 0.4 / track.dt)), "bandpass", fs=1.0 / track.dt, output="sos")
    both = sosfiltfilt(band, np.concatenate([y[None], x, delayed[0], z, delayed[1]]), axis=1)[:, edge:-edge]
    limited = _limited(track, ruling, gain[0] * (sent - rates) - gain[2] * slope, vehicle, edge)
    for k in range(0, both.shape[1] - size // 2, size):
        if not limited[k : k + size].any():
            for axis in range(3):
                part = both[:, k : k + size, axis]
                yield axis, part[6:] @ part[:6].T


def _limited(track: Track, ruling, kick: np.ndarray, vehicle, edge: int) -> np.ndarray:
    """Rows near one whose motors were at a limit: they obey no gains, be it for the first tick after a jump of the command, and
    the filter carries that on."""
    asked = ruling[:, -1, :1] + kick @ np.asarray(mixer(vehicle), float).T
    limited = ((np.abs(track.motor - 0.5) > 0.5 - MARGIN) | (np.abs(asked - 0.5) > 0.5 - MARGIN)).any(1)
    return np.convolve(limited, np.ones(2 * edge // 3 + 1), "same")[edge:-edge] > 0


def _between(found: np.ndarray, units: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Errors (5,) from how much flights and axes differ, widened where they are few. A unit alone is held near the whole
    by the priors, so that what it can't tell doesn't count."""
    each = found[:, :, 0] - found[:, :, 1:] @ theta
    spread = each.T @ each / len(found)
    spread += 1e-9 * np.trace(spread) * np.eye(5)
    precision = np.diag(1.0 / PRIOR**2)
    alone, weights = [], []
    for unit in np.unique(units, axis=0):
        of_unit = (units == unit).all(1)
        own = found[of_unit].sum(0)
        weight = np.linalg.inv(spread * of_unit.sum())
        hessian = own[:, 1:].T @ weight @ own[:, 1:]
        push = own[:, 1:].T @ weight @ (own[:, 0] - own[:, 1:] @ theta)
        alone.append(np.linalg.solve(hessian + precision, push))
        weights.append(1.0 - np.diag(np.linalg.inv(hessian + precision)) / PRIOR**2)
    count = len(alone)
    if count < 2:
        return np.full(5, np.inf)
    alone, weights = np.array(alone), np.array(weights)
    weights = weights / np.maximum(weights.sum(0), 1e-30)
    return (
        np.sqrt((weights * alone**2).sum(0) / (count - 1))
        * student.ppf(norm.cdf(DECISION.standard_errors), count - 1)
        / DECISION.standard_errors
    )


def _moments(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (5,) and errors (5,) that bring the moments (B, 5, 1 + 5) to zero, with weak priors."""
    precision = np.diag(1.0 / PRIOR**2)
    total = found.sum(0)
    theta = np.zeros(5)
    for _ in range(4):
        each = found[:, :, 0] - found[:, :, 1:] @ theta
        spread = each.T @ each * len(found) / max(len(found) - 5, 1)
        spread += 1e-9 * np.trace(spread) * np.eye(5)
        weight = np.linalg.inv(spread)
        hessian = total[:, 1:].T @ weight @ total[:, 1:] + precision
        theta = np.linalg.solve(hessian, total[:, 1:].T @ weight @ total[:, 0])
    return theta, np.sqrt(np.diag(np.linalg.inv(hessian)))

"""The rate loop: its gains, read from what commands excite.

What the motors differ by is the rate controller's output. In closed loop it answers
noise and gusts, so the gains are read by the generalised method of moments (Hansen
1982), with what the nominal loop would have done under the same commands as
instruments: neither colour nor clocks need a model. An observer runs the same loop for
the motor command of every tick.
"""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, detrend, lfilter, sosfiltfilt
from scipy.stats import norm

from openjax.flights.track import Track, smooth
from openjax.gap.channels import Channel, Estimated, robust_deviation
from openjax.gap.channels.instruments import BAND, COUNT, EDGE, SLOW, in_force, outputs_of
from openjax.gap.decision import DECISION
from openjax.gap.model.library import CARDS, shipped_card
from openjax.gap.model.nuisances import TRIM
from openjax.gap.model.observer import GYRO_GAIN, TICKS, observe
from openjax.gap.model.prediction import bucket, pad

GAIN_STEP = 0.05
# Spreads of the gains, from the effect's card, of P's delay and of the share of the
# derivative that is filtered.
PRIOR = np.array([*(p.spread for p in shipped_card("rate_loop").fitted), 1.0, 1.0])
# Hz of the low-pass of the derivative that the firmware of the Crazyflie may have
FILTER = 30.0
# s by which motors may be off, where rows are the log's own and where they are means of
# its rows.
ROW_DELAY = (0.0005, 0.0025)
MARGIN = 0.05  # of a motor command: nearer to its limits some tick of the row was cut
SEGMENT = 0.5  # s, unit of the errors
# s over which what pushes the body is smoothed, run by run; where rows are means, which
# the ticks follow anyway, the first is enough
PUSHES = (SLOW, TRIM, TRIM, TRIM)
SMOOTH = 0.05  # s over which the outputs are compared
GAINS = ("p", "i", "d")


@dataclass(frozen=True, eq=False)
class RateLoop(Channel):
    """The behaviour of the rate controllers on board."""

    change: np.ndarray
    """(6,) of p, i, d as shares: roll and pitch first, then yaw."""
    error: np.ndarray
    """(6,) standard deviations of it."""
    outputs: list[np.ndarray]
    """[(4, T, 3)]: logged less nominal outputs of each track, and what one more of p,
    i, d would give.
    """
    ticks: list[np.ndarray]
    """[(T, TICKS, 4)]: the motor commands of the rate loop's ticks."""
    names: tuple[str, ...]
    """The effects that it tells."""
    dt: float = 0.01
    path = "rate_loop"

    @cached_property
    def gain(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes (3,) of p, i, d and their errors, of roll, pitch and yaw together: by
        their precision, with an error that covers what the two disagree by (Birge
        1932).
        """
        value = self.change.reshape(2, 3)
        error = self.error.reshape(2, 3)
        weight = 1.0 / np.maximum(error, 1e-9) ** 2
        total = np.maximum(weight.sum(0), 1e-12)
        mean = (weight * value).sum(0) / total
        apart = np.sqrt((weight * (value - mean) ** 2).sum(0))
        return mean, np.maximum(apart, 1.0) / np.sqrt(total)

    def acting(self) -> dict[str, float]:
        """Either group of axes may be retuned alone: the surer one tells, if P changes
        by more than forms are wrong by.
        """
        change = np.abs(self.change[[0, 3]])
        # flights that tell nothing leave what was known before
        error = np.minimum(self.error[[0, 3]], PRIOR[0])
        # Savage and Dickey's
        nats = 0.5 * (change / error) ** 2 - np.log(PRIOR[0] / error)
        chance = norm.cdf((change - DECISION.form_error) / error) * (1.0 - DECISION.unknown)
        odds = {e: chance[nats + CARDS[e].log_odds > 0.0].max(initial=0.0) for e in self.names}
        return {e: float(p) for e, p in odds.items() if p > DECISION.least_probability}

    def undetectable(self) -> list[str]:
        detectable = PRIOR[0] > 2.0 * DECISION.standard_errors * self.error[[0, 3]].min()
        return [] if detectable else list(self.names)

    def estimate(self, effect: str, parameter: str) -> Estimated:
        place = GAINS.index(parameter)
        change, error = (float(v[place]) for v in self.gain)
        return Estimated(1.0 + change, error, error)

    def residuals(self, effects) -> dict[str, list[np.ndarray]]:
        changes = -self.gain[0] if set(effects) & set(self.names) else np.zeros(3)
        weights = np.append(1.0, changes)
        out: dict[str, list[np.ndarray]] = {"motors roll": [], "motors pitch": [], "motors yaw": []}
        for outputs in self.outputs:
            errors = detrend(np.tensordot(weights, outputs, 1), axis=0)
            for column, series in zip(errors.T, out.values(), strict=True):
                series.append(smooth(column, SMOOTH, self.dt))
        return out


def read_rate_loop(reading) -> RateLoop:
    """Read the rate controllers of all tracks of a `motion.Reading`."""
    ticks = []
    series = []
    outputs = []
    tracks = zip(
        reading.firmware_tracks,
        reading.vehicles,
        reading.arrivals,
        reading.by_commands,
        strict=True,
    )
    for track, vehicle, link, (_, commanded_rates) in tracks:
        requests, motor_ticks = observe_track(track, vehicle, link, reading.at_once)
        ticks.append(motor_ticks)
        logged_outputs, nominal, *larger = np.concatenate(
            [track.motor[None], requests]
        ) @ outputs_of(vehicle)
        slopes = [(variant - nominal) / GAIN_STEP for variant in larger]
        outputs.append(np.stack([logged_outputs - nominal, *slopes]))
        series.append(_series(track, vehicle, in_force(track, link), commanded_rates, reading))
    change, error = read_gains(reading, series, ticks)
    names = reading.library.of("rate_loop")
    return RateLoop(
        change, error, outputs, ticks, names, max(t.dt for t in reading.firmware_tracks)
    )


def with_motors(track: Track, vehicle) -> Track:
    """The track with motor commands: where they weren't logged, those that the nominal
    rate controller would send.
    """
    if track.motor is not None:
        return track
    rows = np.arange(len(track))
    # without motors it isn't known when commands arrive: at once
    link = (0.0, np.stack([rows, np.maximum(rows - 1, 0)], 1))
    track = dataclasses.replace(track, motor=np.repeat(track.command[:, :1], 4, 1))
    # the first pass is driven by the collective thrust alone, the second by the motors
    # of the first
    for _ in range(2):
        requests, _ = observe_track(track, vehicle, link)
        track = dataclasses.replace(track, motor=requests[0], motors_logged=False)
    return track


def observe_track(track: Track, vehicle, link, at_once=False):
    """The observer's output: mean motor commands (1 + 3, T, 4) that the nominal loop
    wants, and with one gain each larger by GAIN_STEP; and the commands sent in the
    ticks (T, TICKS, 4).

    What pushed the body beyond the nominal physics in a first run is given to a second,
    so that the rates inside a row are right whatever the physics. Where motors are
    single samples, the loop within a row has answered half of a push by then, and of
    what holds against an offset of the centre of mass a quarter would be missing in the
    second run: more runs find the rest.
    """
    rows = len(track)
    size = bucket(rows)
    command = pad(in_force(track, link), size)
    motor = pad(track.motor, size)
    gyro = pad(track.body_rates, size)
    dt = np.float32(track.dt)
    push = np.zeros((size, 3), np.float32)
    for width in PUSHES if at_once else PUSHES[:1]:
        *_, rates = observe(vehicle, vehicle, command, motor, gyro, push, dt, at_once)
        miss = track.body_rates[1:] - np.asarray(rates, float)[: rows - 1]
        # without the observer's own correction of what it missed before
        step = miss.copy()
        step[1:] -= (1.0 - GYRO_GAIN) * miss[:-1]
        change = smooth(np.concatenate([step, step[-1:]]), width, track.dt) / track.dt
        push = push + pad(change, size)
    gains = ("rate_kp", "rate_ki", "rate_kd")
    larger = [vehicle.replace(**{n: (1.0 + GAIN_STEP) * getattr(vehicle, n)}) for n in gains]
    runs = [
        observe(controller, vehicle, command, motor, gyro, push, dt, at_once)
        for controller in (vehicle, *larger)
    ]
    requests = np.array([run[0] for run in runs], float)[:, :rows]
    return requests, np.asarray(runs[0][1])[:rows]


def read_gains(reading, series, ticks) -> tuple[np.ndarray, np.ndarray]:
    """Changes (6,) of p, i, d as shares - roll and pitch, then yaw - and their errors,
    infinite where flights say too little. `series`: `_series` of each track; `ticks`:
    as in `RateLoop`.
    """
    change = np.zeros(6)
    error = np.full(6, np.inf)
    if reading.late is None:
        return change, error
    moments: dict[int, list] = {
        0: [],
        1: [],
        2: [],
    }  # axis: [(moments (5, 1 + 5), track)] of every segment
    power = np.zeros((2, 3))
    flights = zip(reading.firmware_tracks, reading.vehicles, series, ticks, strict=True)
    for unit, (track, vehicle, of, motor_ticks) in enumerate(flights):
        power += excitation(track, vehicle, of)
        for axis, part in _segments(of, motor_ticks, track.dt):
            moments[axis].append((part, unit))
    for group, axes in enumerate(((0, 1), (2,))):
        segment_moments = np.array([m for a in axes for m, _ in moments[a]])
        units = np.array([3 * u + a for a in axes for _, u in moments[a]])
        signal, noise = power[:, axes].sum(1)
        excites = signal > DECISION.loop_signal**2 * noise
        if excites and len(segment_moments) * SEGMENT >= DECISION.loop_seconds * len(axes):
            columns = slice(3 * group, 3 * group + 3)
            theta, deviation = _moments(segment_moments, units)
            change[columns], error[columns] = theta[:3], deviation[:3]
    return change, error


def excitation(track: Track, vehicle, series: np.ndarray) -> np.ndarray:
    """(2, 3) squares, summed over rows of a track and its `_series`, of P's input
    within BAND in rad/s: what commands make of it, and the gyroscope's noise as rows
    show it beside smooth rates.
    """
    gain = np.asarray(vehicle.rate_kp, float) * COUNT
    response = sosfiltfilt(_band(track.dt), series[6] / gain, axis=0)
    bends = np.diff(track.body_rates, 2, axis=0)
    share = 2.0 * track.dt * (min(BAND[1], 0.4 / track.dt) - BAND[0])
    # white noise of variance one has second differences of 1 + 4 + 1
    noise = share * bends.var(0) / 6.0
    return np.stack([(response**2).sum(0), len(track) * noise])


def _band(dt: float) -> np.ndarray:
    return butter(2, (BAND[0], min(BAND[1], 0.4 / dt)), "bandpass", fs=1.0 / dt, output="sos")


def _series(
    track: Track, vehicle, ruling: np.ndarray, commanded_rates: np.ndarray, reading
) -> np.ndarray:
    """(11, T, 3): outputs beyond the nominal ones, what P, I and D make of the rates,
    what a delay does to P and a low-pass to D, and the last five again of the rates
    `commanded_rates` (T, 3) that commands alone cause: the instruments.

    The rates at the ticks of a row lie on a smooth curve through those of the rows; the
    derivative is of the tick before.
    """

    def of_row(ticks):
        """The part of the ticks (T, TICKS, 3) that a row of the log shows (T, 3)."""
        if reading.at_once:
            return ticks[:, 0]
        if track.fast_thrust is None:
            return ticks.mean(1)
        return ticks[:, TICKS // 2]  # rows of a faster log are means already

    at = np.arange(len(track))[:, None] + np.arange(TICKS) / TICKS
    curve = CubicSpline(np.arange(len(track)), track.body_rates)
    rates = curve(at)
    slopes = (curve(at) - curve(at - 1.0 / TICKS)) * TICKS / track.dt
    low = butter(2, FILTER, fs=TICKS / track.dt)
    low_passed = lfilter(*low, slopes.reshape(-1, 3), axis=0).reshape(slopes.shape)
    rate_commands = of_row(ruling[..., 1:])
    slope = of_row(slopes)
    x = _terms(track, vehicle, rate_commands - of_row(rates), slope)
    z = _terms(
        track,
        vehicle,
        rate_commands - commanded_rates,
        np.gradient(commanded_rates, track.dt, axis=0),
    )
    apart = reading.late or 0.0
    off = [
        apart * np.gradient(x[0], track.dt, axis=0),
        _terms(track, vehicle, rate_commands, of_row(low_passed) - slope)[2],
    ]
    late = [apart * np.gradient(v, track.dt, axis=0) for v in z[[0, 2]]]
    y = track.motor @ outputs_of(vehicle) - x.sum(0)
    return np.stack([y, *x, *off, *z, *late])


def _terms(track: Track, vehicle, error: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """(3, T, 3): outputs of P, I and D for an error of the body rates and their slope
    (T, 3).
    """
    p = np.asarray(vehicle.rate_kp, float) * COUNT
    i = np.asarray(vehicle.rate_ki, float) * COUNT
    d = np.asarray(vehicle.rate_kd, float) * COUNT
    return np.stack([p * error, i * np.cumsum(error, 0) * track.dt, -d * slope])


def _segments(series: np.ndarray, ticks: np.ndarray, dt: float):
    """(axis, moments (5, 1 + 5)) of each segment of a series (11, T, 3) without a motor
    near its limits, which obeys no gains.
    """
    edge = int(EDGE / dt)
    size = max(int(SEGMENT / dt), 1)
    if series.shape[1] < 4 * edge + size:
        return
    band_passed = sosfiltfilt(_band(dt), series, axis=1)[:, edge:-edge]
    at_limit = (np.abs(ticks - 0.5) > 0.5 - MARGIN).any((1, 2))
    at_limit = np.convolve(at_limit, np.ones(2 * edge // 3 + 1), "same")[edge:-edge] > 0
    for k in range(0, band_passed.shape[1] - size // 2, size):
        if not at_limit[k : k + size].any():
            for axis in range(3):
                part = band_passed[:, k : k + size, axis]
                yield axis, part[6:] @ part[:6].T


def _moments(moments: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (5,) and errors (5,) that bring the moments (B, 5, 1 + 5) to zero,
    with weak priors. Errors are what segments or, where that is more, `units` (B,)
    differ by.
    """
    precision = np.diag(1.0 / PRIOR**2)
    total = moments.sum(0)
    theta = np.zeros(5)
    # the best weights depend on the coefficients, and these on the weights
    for _ in range(4):
        each = moments[:, :, 0] - moments[:, :, 1:] @ theta
        spread = each.T @ each * len(moments) / max(len(moments) - 5, 1)
        # fewer blocks than numbers leave a spread that has no inverse
        weight = np.linalg.inv(spread + 1e-9 * np.trace(spread) * np.eye(5))
        covariance = np.linalg.inv(total[:, 1:].T @ weight @ total[:, 1:] + precision)
        theta = covariance @ total[:, 1:].T @ weight @ total[:, 0]
    pushes = np.array([each[units == u].sum(0) for u in np.unique(units)]) @ weight @ total[:, 1:]
    return theta, robust_deviation(covariance, pushes)

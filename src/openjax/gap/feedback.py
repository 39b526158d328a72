"""What commands caused of the motors, and what feedback made of them.

In closed loop the motors answer gusts, noise of the gyroscope and whatever pushes the body, so a regression on the motors
as logged is biased: towards weak motors where they were logged as single samples, towards any cause that feedback
follows. What body-rate commands caused is free of all that. It serves as an instrument (two-stage least squares): the
first stage here tells the two parts apart; the second lets the feedback part do what it likes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt
from scipy.stats import t as student

from openjax.flights.track import Track, smooth
from openjax.gap.nuisances import TRIM
from openjax.gap.observer import TICKS, commanded
from openjax.gap.prediction import bucket, padded
from openjax.vehicle.rate_controller import mixer

SLOW = 0.06  # s over which commands implied by motors and rates are smoothed
QUICK = 0.1  # s: within it, single samples say little about what motors did between them
LOOP_PERIOD = 0.002  # s, of the firmware's rate loop
AT_ONCE = 0.12  # of the answer to one sample: above, motors may be single samples
AT_ONCE_SELDOM = 0.22  # likewise in rows of over 12 ms, whose differences hold as much motion as noise
BAND = (0.5, 10.0)  # Hz in which the loop's gains are read: above trims, below filters and single samples
EDGE = 0.3  # s at either end that the filters spoil
LEAST_CHANGE = 0.15  # of a gain: filters of a firmware do less
CLEAR = 3.0  # standard errors
ALONE = 5.0  # likewise, where yaw says otherwise
YAW_ERROR = 0.05  # of a gain, what rows leave
LEAST_YAW = 0.09  # of yaw's P where rows show all that the loop does
MOST_LEFT = 0.06  # of the power of yaw's outputs that a read loop leaves there
LOST = 0.1  # of a gain, by which D may fall beyond P
ONE_SIDED = 0.00135  # chance of a normal number beyond three of them
PRIOR = np.array([0.4, 0.4, 0.4, 1.0, 1.0])  # spreads of the gains and of the delays of P and D
MARGIN = 0.05  # of a motor command: nearer to its limits some tick of the row was cut
LEAST_SECONDS = 6  # without a motor at its limit
GRANULE = 0.5  # s, unit of the errors
FILTER_DELAY = 0.004  # s, usual size of what low-passes do to the derivative
# s by which motors may be off, where rows are the log's own and where they are means of its rows
ROW_DELAY = (0.0005, 0.0025)
COUNT = 57.29577951308232 / 65536.0  # motor command per count and rad/s


@dataclass(frozen=True, eq=False)
class Feedback:
    """Of one track: `acceleration` (T, 3) rad/s^2 that the feedback part of the motors makes, through their lag;
    `quick` (T, 3) the same of what motors do within QUICK s, whoever caused it; `caused` (T, 3) the same of what the
    commands caused."""

    acceleration: np.ndarray
    quick: np.ndarray
    caused: np.ndarray


@dataclass(frozen=True, eq=False)
class Gains:
    """Changes of the rate loop's p, i, d as shares, roll and pitch first and then yaw: `change` (6,), `error` (6,), from what
    commands excite; `yaw`: the change of yaw's P read row by row, and its error; `yaw_left`: the share of the power of yaw's
    outputs that rows leave then."""

    change: np.ndarray
    error: np.ndarray
    yaw: tuple[float, float] = (0.0, np.inf)
    yaw_left: float = 1.0

    @property
    def clear(self) -> bool:
        """Whether P, which tells, is changed by more than filters of a firmware do and beyond doubt."""
        return self.by_yaw or self._by_commands

    @property
    def readable(self) -> bool:
        """Whether either reading could tell."""
        return bool(np.isfinite(self.error).any() or self.yaw_left < MOST_LEFT)

    @property
    def by_yaw(self) -> bool:
        """Whether yaw's rows tell: yaw has no D that a filter could bend. Rows that see half of the motors, or another clock,
        make gains look small and leave much, so a smaller one needs what commands excite to agree then."""
        change, error = self.yaw
        if self.yaw_left < MOST_LEFT:
            return abs(change) > max(LEAST_YAW, CLEAR * float(np.hypot(error, self.yaw_left)))
        if abs(change) < max(LEAST_CHANGE, CLEAR * error):
            return False
        apart, unsure = abs(self.change[3] - change), self.error[3]
        return change > 0.0 or bool(unsure < LEAST_CHANGE and apart < 2.0 * unsure)

    @property
    def _by_commands(self) -> bool:
        """A D that is lost faster than P is a low-pass, or noise that the loop didn't see. Roll and pitch alone, with a yaw
        that is as it should be, need more."""
        size, error = np.abs(self.change[[0, 3]]), self.error[[0, 3]]
        as_usual = abs(self.yaw[0]) + CLEAR * self.yaw[1] < LEAST_CHANGE
        sure = np.array([ALONE if as_usual else CLEAR, CLEAR])
        changed = size > np.maximum(LEAST_CHANGE, sure * error)
        alike = self.change[3] * self.yaw[0] > 0.0 or not np.isfinite(self.yaw[1])
        return bool(changed[0] and self.change[2] > self.change[0] - LOST) or bool(
            changed[1] and alike and not as_usual
        )

    @property
    def found(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes (3,) of p, i, d, and their errors (3,)."""
        if self.by_yaw and not self._by_commands:
            change, error = self.yaw
            return np.array([change, 0.0, 0.0]), np.array([max(error, YAW_ERROR), PRIOR[1], PRIOR[2]])
        return self.change[:3], self.error[:3]


def outputs_of(vehicle) -> np.ndarray:
    """(4, 3) that turns motor commands into the rate controller's outputs, roll, pitch, yaw."""
    return np.linalg.pinv(np.asarray(mixer(vehicle), float)).T


def in_force(track: Track, arrived) -> np.ndarray:
    """Command (T, TICKS, 4) that rules at each tick of the rate loop."""
    part, rows = arrived
    out = np.repeat(track.command[rows[:, 0]][:, None], TICKS, 1)
    older = round(part * TICKS)
    out[:, :older] = track.command[rows[:, 1]][:, None]
    return out


def read_feedback(tracks, vehicles, by_commands) -> list[Feedback]:
    """The feedback part of every track's motors. `by_commands`: `caused_by_commands` of each."""
    given, caused, made = [], [], []
    for track, vehicle, (motors, _) in zip(tracks, vehicles, by_commands, strict=True):
        outputs = outputs_of(vehicle)
        given.append(motors - motors.mean(0))
        caused.append(given[-1] @ outputs)
        made.append(track.motor @ outputs)
    # First stage: as much of the outputs as is proportional to what commands would have caused, axis by axis. More freedom
    # (a filter) would let the outer loop's answers to gusts in.
    made = [m - m.mean(0) for m in made]
    power = sum((c * c).sum(0) for c in caused)
    share = sum((c * m).sum(0) for c, m in zip(caused, made, strict=True)) / np.maximum(power, 1e-12)
    rest = [m - share * c for c, m in zip(caused, made, strict=True)]
    return [
        Feedback(
            _turning((r - smooth(r, TRIM, t.dt)) @ np.asarray(mixer(v), float).T, t, v),
            _turning(t.motor - smooth(t.motor, QUICK, t.dt), t, v),
            _turning(g, t, v),
        )
        for r, g, t, v in zip(rest, given, tracks, vehicles, strict=True)
    ]


def gustiness(tracks, feedback: list[Feedback], floor) -> np.ndarray:
    """(3,) rms of the angular accelerations that nothing explains over those that commands caused, in BAND. Commands
    answer gusts too, by way of the attitude, so this bounds how wrong torques may look. `floor` [(T, 9)]: residuals when
    all effects may act."""
    left, caused = np.zeros(3), np.full(3, 1e-12)
    for track, part, rest in zip(tracks, feedback, floor, strict=True):
        band = butter(2, BAND, "bandpass", fs=1.0 / track.dt, output="sos")
        edge = int(EDGE / track.dt)
        both = np.stack([np.gradient(rest[:, :3], track.dt, axis=0), part.caused])[:, edge:]
        both = sosfiltfilt(band, both, axis=1)[:, edge:-edge]
        left += (both[0] ** 2).sum(0)
        caused += (both[1] ** 2).sum(0)
    return np.sqrt(left / caused)


def caused_by_commands(track: Track, vehicle, link) -> tuple[np.ndarray, np.ndarray]:
    """Motor commands (T, 4) and rates (T, 3) that the body-rate commands alone cause; `link`: what arrived of them, None where
    that wasn't read. Where none were logged, the nominal controller's law says which ones the motors and rates imply, slowly."""
    if track.command is not None:
        sent = track.command if link is None else in_force(track, link).mean(1)
    else:
        gain = np.asarray(vehicle.rate_kp, float) * COUNT
        implied = track.motor @ outputs_of(vehicle) / gain + track.body_rates
        sent = np.concatenate(
            [track.motor.mean(1)[:, None], smooth(implied - implied.mean(0), SLOW, track.dt)], 1
        )
    motors, rates = commanded(vehicle, padded(sent, bucket(len(track))), np.float32(track.dt))
    return np.asarray(motors, float)[: len(track)], np.asarray(rates, float)[: len(track)]


def _turning(motors: np.ndarray, track: Track, vehicle) -> np.ndarray:
    """Angular acceleration (T, 3) that changes of the motor commands (T, 4) make, through the motors' lag."""
    blend = -np.expm1(-track.dt / float(vehicle.motor_time_constant))
    pushed = lfilter([blend], [1.0, blend - 1.0], motors, axis=0)
    thrust = pushed * float(vehicle.thrust_constant * vehicle.max_rotor_speed**2)
    place, spin = np.asarray(vehicle.rotor_position, float), np.asarray(vehicle.rotor_spin, float)
    ratio = float(vehicle.torque_constant / vehicle.thrust_constant)
    torque = np.stack([thrust @ place[:, 1], -thrust @ place[:, 0], ratio * (thrust @ spin)], 1)
    return torque / np.asarray(vehicle.inertia, float)


def answers_noise(tracks, vehicles) -> float:
    """How much the motors of a row answer the noise of the same row's gyroscope, of the whole P and D of the loop: a single
    sample does, a mean over several ticks hardly."""
    product = square = expected = 0.0
    for track, vehicle in zip(tracks, vehicles, strict=True):
        u = np.diff(track.motor @ outputs_of(vehicle), 3, axis=0)[:, :2]
        g = np.diff(track.body_rates, 3, axis=0)[:, :2]
        product += float((u * g).sum())
        square += float((g * g).sum())
        gain = np.asarray(vehicle.rate_kp, float) + np.asarray(vehicle.rate_kd, float) / LOOP_PERIOD
        expected = -float(gain[:2].mean()) * COUNT
    return product / square / expected if square > 0.0 else 0.0


def read_gains(tracks, vehicles, links, by_commands, at_once: bool, late: float) -> Gains:
    """The rate loop's gains from what commands excite: the motors' outputs against error, its integral and the rates'
    slope as the gyroscope has them, with what the nominal loop would have done under the same commands as instruments.
    `late` s: by how much the motors' rows may be off against the gyroscope's. Moments over short times, weighed by their
    own spread (generalised method of moments, Hansen 1982), so that neither colour nor clocks need a model."""
    moments: dict[int, list] = {0: [], 1: [], 2: []}  # axis: [(moments, unit)] of every granule
    flights = zip(tracks, vehicles, links, by_commands, strict=True)
    for unit, (track, vehicle, link, (_, drawn)) in enumerate(flights):
        ruling = in_force(track, link)
        sent = ruling[:, 0, 1:] if at_once else ruling[..., 1:].mean(1)
        rates = track.body_rates
        after = np.concatenate([rates[1:], rates[-1:]])
        slope = (after - rates) / track.dt
        if at_once:
            slope = 0.5 * (slope + np.concatenate([slope[:1], slope[:-1]]))
        gain = [np.asarray(getattr(vehicle, n), float) * COUNT for n in ("rate_kp", "rate_ki", "rate_kd")]

        def tied(rates, slope, sent=sent, gain=gain, dt=track.dt):
            error = sent - rates
            return np.stack([gain[0] * error, gain[1] * np.cumsum(error, 0) * dt, -gain[2] * slope])

        x = tied(rates if at_once else 0.5 * (rates + after), slope)
        z = tied(drawn, np.gradient(drawn, track.dt, axis=0))
        y = track.motor @ outputs_of(vehicle) - x.sum(0)
        band = butter(2, (BAND[0], min(BAND[1], 0.4 / track.dt)), "bandpass", fs=1.0 / track.dt, output="sos")
        edge, size = int(EDGE / track.dt), max(int(GRANULE / track.dt), 1)
        if len(track) < 4 * edge + size:
            continue
        times = np.array([late, FILTER_DELAY])[:, None, None]
        delayed = [times * np.gradient(v[[0, 2]], track.dt, axis=1) for v in (x, z)]
        both = np.concatenate([y[None], x, delayed[0], z, delayed[1]])
        both = sosfiltfilt(band, both, axis=1)[:, edge:-edge]
        # A motor at its limit obeys no gains, be it for the first tick after a jump of the command; the filter carries that on.
        kick = gain[0] * (sent - rates) - gain[2] * slope
        asked = ruling[:, -1, :1] + kick @ np.asarray(mixer(vehicle), float).T
        limited = ((np.abs(track.motor - 0.5) > 0.5 - MARGIN) | (np.abs(asked - 0.5) > 0.5 - MARGIN)).any(1)
        limited = np.convolve(limited, np.ones(2 * edge // 3 + 1), "same")[edge:-edge] > 0
        for k in range(0, both.shape[1] - size // 2, size):
            if limited[k : k + size].any():
                continue
            for axis in range(3):
                part = both[:, k : k + size, axis]
                moments[axis].append((part[6:] @ part[:6].T, unit))  # (5, 1 + 5)
    change, error = np.zeros(6), np.full(6, np.inf)
    for group, axes in enumerate(((0, 1), (2,))):
        found = np.array([m for a in axes for m, _ in moments[a]])
        units = np.array([(a, u) for a in axes for _, u in moments[a]])
        if len(found) * GRANULE < LEAST_SECONDS * len(axes):
            continue
        theta, spread = _moments(found)
        change[3 * group : 3 * group + 3] = theta[:3]
        error[3 * group : 3 * group + 3] = np.maximum(spread, _between(found, units, theta))[:3]
    return Gains(change, error)


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
    return np.sqrt((weights * alone**2).sum(0) / (count - 1)) * student.ppf(1.0 - ONE_SIDED, count - 1) / 3.0


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

"""Sensors against each other, without any dynamics: what rigid-body kinematics alone says about a
log.

Attitude's rate against the gyroscope gives the gyroscope's gain; the path's acceleration against
the accelerometer, turned into the world, gives the tilt of the world in which motion capture
reports. A sensor that is off by more than sensors usually are is a finding about the sensors, is
corrected before the physics is read, and is no cause.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import nnls
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from openjax.flights.track import GRAVITY, Track, rotation, to_world, turn_increments

BAND = (0.3, 6.0)  # Hz: above drift, below most of the sensors' noise
BLOCK = 1.0  # s that are left out together for an error
EDGE = 0.3  # s at either end that a filter spoils
SLOW = 2.0  # Hz, below which path and accelerometer are compared
CLEAR = 5.0  # jackknife standard errors by which a finding must exceed nothing
LEAST = 0.1  # rad/s or m/s^2 rms in the band: an axis that hardly moves shows no gain
# s: clocks that are less apart cost no correlation worth mentioning at 2 Hz
WANDER = 0.015
# correlation below which the two streams don't fit well enough to compare gains
COHERENT = 0.97
ONE_CLOCK = 0.93  # below which they don't share a clock


@dataclass(frozen=True)
class Kinematics:
    """Comparisons between the sensors of a case."""

    gain: float
    """Of the gyroscope, 1 where it isn't clearly another."""
    tilt: np.ndarray | None
    """(2,) rad by which the world leans about its x and y axes; None where that isn't clear."""
    one_clock: bool
    """True if attitude and gyroscope can be compared sample by sample: what their
    streams leave of each other is noise, not time.
    """
    findings: dict[str, str]
    """Quantities that are off by more than usual, in words, by name."""
    motor_clock: bool = True
    """The same of motors and gyroscope, see `MotorClock`."""
    motors_late: Mapping[str, float] = field(default_factory=dict)
    """{flight and vehicle: s by which its motor commands stand later in the log than they act}."""


def read_kinematics(tracks: list[Track], limits) -> Kinematics:
    """Compare the sensors of all tracks of one case. `limits`: `gyroscope_gain` that a sensor may
    be off by, `world_tilt` in degrees, and the `standard_errors` from which a tilt is clear.
    """
    streams = _streams(tracks, _turning, BAND)
    gain, error, coherence, turning = _gains(streams)
    on_two_clocks = turning & (coherence < ONE_CLOCK)
    # An estimator's noise costs correlation as well, and is no matter of time.
    one_clock = int(on_two_clocks.sum()) < 2 or _wander(streams) < WANDER
    tilt = None
    findings = {}
    if words := _unusual(gain, error, limits.gyroscope_gain):
        findings["gyroscope gain"] = f"the gyroscope reads {words} times the rate of the attitude"
    scale = _gains(_streams(tracks, _accelerating, (BAND[0], SLOW)))
    if words := _unusual(scale[0], scale[1], limits.gyroscope_gain):
        findings["scale"] = (
            f"positions change by {words} times what accelerometer and attitude feel: check their "
            "scale"
        )
    if not one_clock:
        words = ", ".join(f"{a} {c:.2f}" for a, c in zip("xyz", coherence, strict=True))
        findings["clocks"] = (
            f"gyroscope and attitude don't share a clock (correlation {words} between {BAND[0]} "
            f"and {BAND[1]:g} Hz): torques and lags can't be told from these logs"
        )
    if (world := _world(tracks)) is not None:
        lean, lean_error = world
        size = float(np.hypot(*lean))
        tilt = lean if size >= limits.standard_errors * float(np.hypot(*lean_error)) else None
        # of the error's two axes what lies along the lean
        along = lean / max(size, 1e-12)
        error_along = float(np.sqrt(along**2 @ lean_error**2))
        if size > max(np.radians(limits.world_tilt), CLEAR * error_along):
            findings["world tilt"] = (
                f"motion capture's world leans by {np.degrees(size):.1f} degrees against gravity "
                f"({np.degrees(lean[0]):+.1f} about x, {np.degrees(lean[1]):+.1f} about y)"
            )
    return Kinematics(_of_one_chip(gain, error, limits.standard_errors), tilt, one_clock, findings)


def _of_one_chip(gain: np.ndarray, error: np.ndarray, standard_errors: float) -> float:
    """The gain of all axes (3,) by their precision, where it differs from 1 by more than so many
    standard errors, which cover what the axes disagree by (Birge 1932); else 1.
    """
    is_known = np.isfinite(gain)
    if not is_known.any():
        return 1.0
    gain = gain[is_known]
    weight = 1.0 / np.maximum(error[is_known], 1e-6) ** 2
    mean = float((weight * gain).sum() / weight.sum())
    dispersion = (weight * (gain - mean) ** 2).sum() / max(len(gain) - 1, 1)
    clear = abs(mean - 1.0) > standard_errors * np.sqrt(max(dispersion, 1.0) / weight.sum())
    return mean if clear else 1.0


def _unusual(gain: np.ndarray, error: np.ndarray, usual: float) -> str:
    """The axes whose gain is clearly off by more than sensors usually are, where these
    are two or more.
    """
    away = np.abs(gain - 1.0)  # NaN where it isn't known
    off = (away > CLEAR * error) & (away > usual)
    # of a single axis it may be the calibration of that; two or more say that it is the unit
    if off.sum() < 2:
        return ""
    return ", ".join(f"{a} {g:.3f}" for a, g, o in zip("xyz", gain, off, strict=True) if o)


def correct(track: Track, kinematics: Kinematics) -> Track:
    """The track as it would read with sensors that agree."""
    changes = {}
    if kinematics.gain != 1.0:
        changes["body_rates"] = track.body_rates / kinematics.gain
    if kinematics.tilt is not None:
        turn = Rotation.from_rotvec([*-kinematics.tilt, 0.0])
        channels = [n for n in ("position", "velocity") if getattr(track, n) is not None]
        changes |= {name: turn.apply(getattr(track, name)) for name in channels}
        attitude = turn * Rotation.from_quat(track.quaternion, scalar_first=True)
        changes["quaternion"] = attitude.as_quat(scalar_first=True)
        if len(track.neighbours):
            changes["neighbours"] = np.stack([turn.apply(p) for p in track.neighbours])
    return dataclasses.replace(track, **changes) if changes else track


def _turning(track: Track) -> tuple[np.ndarray, np.ndarray] | None:
    """Rate of the attitude (T, 3) and gyroscope (T, 3), rad/s."""
    if track.quaternion is None or track.body_rates is None:
        return None
    # between two rows, where the attitude's increment is
    gyroscope = 0.5 * (track.body_rates[1:] + track.body_rates[:-1])
    return turn_increments(track.quaternion) / track.dt, gyroscope


def _accelerating(track: Track) -> tuple[np.ndarray, np.ndarray] | None:
    """The accelerometer's reading (T, 3) and the acceleration of the position (T, 3), m/s^2 in the
    world.
    """
    if track.quaternion is None or track.position is None or track.specific_force is None:
        return None
    force = to_world(track.quaternion, track.specific_force)
    velocity = np.gradient(track.position, track.dt, axis=0)
    return force, np.gradient(velocity, track.dt, axis=0)


def _streams(tracks, signals_of, band) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Row period (s) and two signals (T, 3) in `band` without the ends, of each track
    that has them and is long enough to be filtered.
    """
    out = []
    for track in tracks:
        signals = signals_of(track)
        edge = int(EDGE / track.dt)
        if signals is None or len(signals[0]) < 4 * edge:
            continue
        bandpass = butter(2, band, "bandpass", fs=1.0 / track.dt, output="sos")
        first, second = (sosfiltfilt(bandpass, v, axis=0)[edge:-edge] for v in signals)
        out.append((track.dt, first, second))
    return out


def _gains(streams) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gain (3,) of the second signal over the first, its error (3,) and their
    correlation (3,), axis by axis; whether an axis moves enough (3,).
    """
    sums = []  # per granule: (4, 3) sums of squares and products, and rows
    for dt, a, b in streams:
        size = max(int(BLOCK / dt), 1)
        for k in range(0, len(a) - size // 2, size):
            p = a[k : k + size]
            q = b[k : k + size]
            squares = [(p * p).sum(0), (p * q).sum(0), (q * q).sum(0)]
            sums.append(np.stack([*squares, np.full(3, len(p))]))
    nothing = np.full(3, np.nan)
    if len(sums) < 4:
        return nothing, nothing, np.ones(3), np.zeros(3, bool)
    sums = np.array(sums)
    total = sums.sum(0)

    def gain_of(s):
        # both have noise: the geometric mean of the two regressions
        return np.sqrt(s[2] / np.maximum(s[0], 1e-12))

    gain = gain_of(total)
    coherence = total[1] / np.sqrt(np.maximum(total[0] * total[2], 1e-12))
    error = _jackknife(sums, gain_of)
    # The quieter of the two: noise alone is no motion.
    moving = np.sqrt(np.minimum(total[0], total[2]) / total[3]) > LEAST
    return (np.where(moving & (coherence > COHERENT), gain, np.nan), error, coherence, moving)


def _wander(streams) -> float:
    """s (rms) by which the clocks of two signals are apart: an error of time grows with how fast a
    signal changes, noise doesn't. Least squares over granules, each axis with a noise of its own.
    """
    deviations = []
    residuals = []
    for dt, a, b in streams:
        size = max(int(BLOCK / dt), 1)
        slope = np.gradient(a, dt, axis=0)
        for k in range(0, len(a) - size // 2, size):
            for axis in range(3):
                part = slice(k, k + size)
                noise = np.zeros(3)
                noise[axis] = len(a[part])
                deviations.append([*noise, (slope[part, axis] ** 2).sum()])
                residuals.append(((a - b)[part, axis] ** 2).sum())
    return (
        float(np.sqrt(nnls(np.array(deviations), np.array(residuals))[0][-1]))
        if deviations
        else 0.0
    )


def _jackknife(sums: np.ndarray, statistic) -> np.ndarray:
    """Standard error of a statistic of the sum of `sums` (N, ...), by leaving each out."""
    left_out = np.array([statistic(sums.sum(0) - s) for s in sums])
    return np.sqrt((len(sums) - 1) / len(sums) * ((left_out - left_out.mean(0)) ** 2).sum(0))


def _world(tracks) -> tuple[np.ndarray, np.ndarray] | None:
    """Tilt (2,) rad of the world about x and y and its error: the accelerometer, turned
    into the world, less the path's acceleration and gravity, is fixed in the world; the
    accelerometer's bias (per flight) is fixed in the body.
    """
    grams = []
    flights = list(dict.fromkeys(t.flight for t in tracks))
    for track in tracks:
        if track.quaternion is None or track.velocity is None or track.specific_force is None:
            return None
        turn = rotation(track.quaternion)
        rest = to_world(track.quaternion, track.specific_force) - np.array([0.0, 0.0, GRAVITY])
        low = butter(2, SLOW, fs=1.0 / track.dt, output="sos")
        edge = int(EDGE / track.dt)
        size = max(int(BLOCK / track.dt), 1)
        rest = rest - np.gradient(track.velocity, track.dt, axis=0)
        if len(rest) < 4 * edge:
            continue
        bias = np.zeros((len(track), 3, 2 + 3 * len(flights)))
        bias[:, 0, 1] = GRAVITY  # gravity, seen from a world that leans
        bias[:, 1, 0] = -GRAVITY
        first_bias = 2 + 3 * flights.index(track.flight)
        bias[:, :, first_bias : first_bias + 3] = turn
        both = np.concatenate([bias, rest[:, :, None]], 2).reshape(len(track), -1)
        both = sosfiltfilt(low, both, axis=0)[edge:-edge].reshape(-1, 3, bias.shape[2] + 1)
        for k in range(0, len(both) - size // 2, size):
            part = both[k : k + size].reshape(-1, both.shape[2])
            grams.append(part.T @ part)
    if len(grams) < 4:
        return None
    grams = np.array(grams)
    total = grams.sum(0)
    rows = sum(len(t) for t in tracks)
    ridge = np.zeros(len(total) - 1)
    ridge[2:] = 1e-3 * rows / max(len(flights), 1)

    def solve(gram):
        return np.linalg.solve(gram[:-1, :-1] + np.diag(ridge), gram[:-1, -1])[:2]

    return solve(total), _jackknife(grams, solve)

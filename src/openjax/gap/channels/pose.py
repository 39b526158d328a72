"""The pose: the attitude against the integrated gyroscope. No dynamics are needed to
see a late pose.
"""

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import Track, earlier, smooth, turn_increments
from openjax.gap.channels import Channel, Estimated
from openjax.gap.decision import DECISION
from openjax.gap.model.library import CARDS, shipped_card
from openjax.gap.model.nuisances import SIZE
from openjax.gap.model.whitening import fit_noise, whiten

(DELAY_SPREAD,) = (p.spread for p in shipped_card("estimator").fitted)  # s
LONGEST = 0.15  # s
STEPS = 6
SMALL_STEP = 2e-4  # s
GYRO_BIAS = 0.1  # rad/s
POSE_HORIZON = 0.1  # s
# s, standard deviation of how late a low-pass at 80 Hz makes a gyroscope
GYROSCOPE_LATE = 0.0017
PASSES = 3  # of fitting the noise model and the delay in turn
START = 20  # rows at the start of a track that the noise model needs


@dataclass(frozen=True, eq=False)
class Delay:
    """`value`, `error`: how late the pose is, s, and the standard error; `nats`: log
    Bayes factor against no delay; `nominal_residual` and `residual` [(T, 3)]: attitude
    less integrated gyroscope, rad, without the delay, all else as fitted, and after the
    fit.
    """

    value: float
    error: float
    nats: float
    nominal_residual: list[np.ndarray]
    residual: list[np.ndarray]


@dataclass(frozen=True, eq=False)
class Pose(Channel):
    """`clock` s by which pose and gyroscope may be apart in these logs; `names`: the
    effects that it tells; `steps`: rows of POSE_HORIZON on each track.
    """

    fit: Delay
    clock: float
    names: tuple[str, ...]
    steps: tuple[int, ...]
    path = "estimator"

    @property
    def late(self) -> bool:
        """True if the pose is clearly late, even if only by little."""
        return self.fit.value > DECISION.standard_errors * self.fit.error and self.fit.nats > 0.0

    def acting(self) -> dict[str, float]:
        odds = {
            e: self.fit.nats + CARDS[e].log_odds for e in self.names if self.fit.value > self.clock
        }
        return {e: 1.0 - DECISION.unknown for e, nats in odds.items() if self.late and nats > 0.0}

    def estimate(self, effect: str, parameter: str) -> Estimated:
        # The delay is against the gyroscope, and a gyroscope may be late itself.
        return Estimated(self.fit.value, self.fit.error, self.fit.error + GYROSCOPE_LATE)

    def residuals(self, effects) -> dict[str, list[np.ndarray]]:
        angles = self.fit.residual if set(effects) & set(self.names) else self.fit.nominal_residual
        changes = [
            np.concatenate([np.zeros((n, 3)), r[n:] - r[:-n]])
            for r, n in zip(angles, self.steps, strict=True)
        ]
        return {f"pose {axis}": [m[:, k] for m in changes] for k, axis in enumerate("xyz")}


def read_pose(tracks: list[Track], library) -> Pose | None:
    """The pose's channel; None without an attitude."""
    if not all(t.logs_attitude for t in tracks):
        return None
    clock = DECISION.nuisance_bound * SIZE["pose_clock"] + max(t.pose_age for t in tracks)
    steps = tuple(max(round(POSE_HORIZON / t.dt), 1) for t in tracks)
    return Pose(read_delay(tracks), clock, library.of("estimator"), steps)


def read_delay(tracks: list[Track]) -> Delay:
    """The delay of the attitude against the gyroscope. A clock offset of a few ms is a nuisance.
    The delay is found by Gauss-Newton steps: the body turns on meanwhile.
    """
    delay = 0.0
    for _ in range(STEPS):
        fit = _read_around(tracks, delay)
        estimate = float(np.clip(fit.value, 0.0 if delay else -LONGEST, LONGEST))
        if abs(estimate - delay) < SMALL_STEP or estimate <= delay == 0.0:
            break
        delay = max(estimate, 0.0)
    return fit


def _read_around(tracks: list[Track], delay: float) -> Delay:
    """The model linearised at a delay: the attitude, what a second of delay does, and
    the nuisances as columns.
    """
    data = []
    for track in tracks:
        increments = turn_increments(track.quaternion)
        gyro, calm = (
            earlier(v, delay, track)
            for v in (track.body_rates, smooth(track.body_rates, 0.03, track.dt))
        )
        between = 0.5 * (gyro[1:] + gyro[:-1]) * track.dt
        start = np.zeros((1, 3))
        # an attitude that comes a second late is behind by what the body turns in that
        # time
        late = -(calm - calm[:1])
        y = np.concatenate([start, np.cumsum(increments - between, 0)]) + delay * late
        time = (track.time - track.time[0])[:, None]
        drift = [GYRO_BIAS * axis * time for axis in np.eye(3)]
        tilt_columns = [
            SIZE["imu_tilt"] * np.concatenate([start, np.cumsum(np.cross(axis, between), 0)])
            for axis in np.eye(3)
        ]
        turned_so_far = np.concatenate([start, np.cumsum(between, 0)])
        gain_columns = [SIZE["gyroscope_gain"] * axis * turned_so_far for axis in np.eye(3)]
        data.append(
            np.stack([y, late, *drift, *tilt_columns, *gain_columns, SIZE["pose_clock"] * late])
        )
    return _fit(data)


def _fit(data: list[np.ndarray]) -> Delay:
    """Fit y = delay x column + nuisances of unit prior variance + coloured noise to
    tracks (2 + N, T, 3) of all these.
    """
    residual = [d[0] - d[0].mean(0) for d in data]
    for _ in range(PASSES):
        noise = fit_noise((0, 1, 2), residual, True, START)
        white = [whiten((noise,), d)[:, START:].reshape(len(d), -1) for d in data]
        cross = [w[2:] @ w[:2].T for w in white]
        nuisances = [
            np.linalg.solve(np.eye(len(c)) + w[2:] @ w[2:].T, c)
            for w, c in zip(white, cross, strict=True)
        ]
        gram = sum(
            w[:2] @ w[:2].T - c.T @ t for w, c, t in zip(white, cross, nuisances, strict=True)
        )
        precision = gram[1, 1] + 1.0 / DELAY_SPREAD**2
        value = gram[1, 0] / precision
        weights = np.array([1.0, -value])
        residual = [
            np.tensordot(np.concatenate([weights, -t @ weights]), d, 1)
            for d, t in zip(data, nuisances, strict=True)
        ]
    # Nuisances stay as they are beside the delay: set free, a clock of a few ms would
    # take any.
    nominal = [r + value * d[1] for r, d in zip(residual, data, strict=True)]
    nats = 0.5 * (gram[1, 0] * value - np.log(precision * DELAY_SPREAD**2))
    return Delay(float(value), float(precision**-0.5), float(nats), nominal, residual)

"""The pose: the attitude against the integrated gyroscope. No dynamics are needed to see a late pose."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from openjax.flights.track import Track, smooth
from openjax.gap.channels import Channel, Estimated, effects_of
from openjax.gap.decision import DECISION
from openjax.gap.model.linear_path import LinearPath, fit_linear_path
from openjax.gap.model.nuisances import SIZE

DELAY_SPREAD = 0.02  # s
LONGEST = 0.15  # s
STEPS = 6
SMALL_STEP = 2e-4  # s
GYRO_BIAS = 0.1  # rad/s
POSE_HORIZON = 0.1  # s
GYROSCOPE_LATE = 0.0017  # s, standard deviation of how late a low-pass at 80 Hz makes a gyroscope


@dataclass(frozen=True, eq=False)
class Pose(Channel):
    """`path`: the fit of the delay; `clock` s by which pose and gyroscope may be apart in these logs; `names`: the effects that
    it tells; `steps`: rows of POSE_HORIZON on each track."""

    fit: LinearPath
    clock: float
    names: tuple[str, ...]
    steps: tuple[int, ...]
    path = "estimator"

    @property
    def delay(self) -> tuple[float, float]:
        """How late the pose is, s, and the standard error."""
        _, delay, covariance = self.fit.score()
        return float(delay[0]), float(np.sqrt(covariance[0, 0]))

    @property
    def late(self) -> bool:
        """Whether the pose clearly is late, be it by little."""
        delay, error = self.delay
        return delay > DECISION.standard_errors * error and self.fit.score()[0] > 0.0

    def acting(self) -> dict[str, float]:
        shown = self.late and self.delay[0] > self.clock
        return dict.fromkeys(self.names, 1.0 - DECISION.unknown) if shown else {}

    def undetectable(self) -> list[str]:
        return []

    def estimate(self, effect: str, parameter: str) -> Estimated:
        delay, error = self.delay
        # The delay is against the gyroscope, and a gyroscope may be late itself.
        return Estimated(delay, error, error + GYROSCOPE_LATE)

    def residuals(self, named) -> dict[str, list[np.ndarray]]:
        used = self.fit.residual if set(named) & set(self.names) else self.fit.before
        moved = [
            np.concatenate([np.zeros((n, 3)), r[n:] - r[:-n]]) for r, n in zip(used, self.steps, strict=True)
        ]
        return {f"pose {axis}": [m[:, k] for m in moved] for k, axis in enumerate("xyz")}


def read_pose(tracks: list[Track], library) -> Pose | None:
    """The pose's channel; None without an attitude."""
    if any(t.quaternion is None for t in tracks):
        return None
    clock = DECISION.clock + max(t.pose_age for t in tracks)
    steps = tuple(max(round(POSE_HORIZON / t.dt), 1) for t in tracks)
    return Pose(read_estimator(tracks), clock, effects_of("estimator", library), steps)


def read_estimator(tracks: list[Track]) -> LinearPath:
    """How late the attitude is against the gyroscope (s, one coefficient); a clock offset of a few ms is a
    nuisance. The delay is found by Gauss-Newton steps: the body turns on meanwhile."""
    delay = 0.0
    for _ in range(STEPS):
        path = _read_around(tracks, delay)
        found = float(np.clip(path.score()[1][0], 0.0 if delay else -LONGEST, LONGEST))
        if abs(found - delay) < SMALL_STEP or found <= delay == 0.0:
            break
        delay = max(found, 0.0)
    return path


def _read_around(tracks: list[Track], delay: float) -> LinearPath:
    """The path linearised at a delay; its coefficient is the whole delay."""
    y, columns, nuisances = [], [], []
    for track in tracks:
        turned = turn_increments(track.quaternion)
        gyro, calm = (
            _late(v, delay, track) for v in (track.body_rates, smooth(track.body_rates, 0.03, track.dt))
        )
        between = 0.5 * (gyro[1:] + gyro[:-1]) * track.dt
        start = np.zeros((1, 3))
        late = -(calm - calm[:1])
        y.append(np.concatenate([start, np.cumsum(turned - between, 0)]) + delay * late)
        columns.append(late[None])
        time = (track.time - track.time[0])[:, None]
        drift = [GYRO_BIAS * axis * time for axis in np.eye(3)]
        tilted = [
            SIZE["imu_tilt"] * np.concatenate([start, np.cumsum(np.cross(axis, between), 0)])
            for axis in np.eye(3)
        ]
        nuisances.append(np.stack([*drift, *tilted, SIZE["pose_clock"] * late]))
    return fit_linear_path(y, columns, nuisances, (DELAY_SPREAD,), (((0, 1, 2), True),))


def _late(values: np.ndarray, delay: float, track: Track) -> np.ndarray:
    """Rows (T, C) as they were `delay` s earlier."""
    return np.stack([np.interp(track.time - delay, track.time, column) for column in values.T], 1)


def turn_increments(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vectors (T - 1, 3), body frame, between successive attitudes (T, 4)."""
    attitude = Rotation.from_quat(quaternion, scalar_first=True)
    return (attitude[:-1].inv() * attitude[1:]).as_rotvec()


def undelayed(track: Track, delay: float) -> Track:
    """The track with its pose `delay` s younger than logged."""
    pose = [n for n in ("position", "quaternion", "velocity") if getattr(track, n) is not None]
    moved = {n: _late(getattr(track, n), -delay, track) for n in pose}
    moved["quaternion"] /= np.linalg.norm(moved["quaternion"], axis=1, keepdims=True)
    return dataclasses.replace(track, **moved)

"""Judge whether a pose may be flown by: a measurement against what a vehicle can have done since
the last good one.

`judge` compares a pose with the last good one of the same source, `agree` motion
capture with the vehicle's own estimate. Both are pure. What they don't accept is a lost
pose, whatever sent it.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from openjax.flying.controller import Pose, moved_on, numbers_of


class Verdict(StrEnum):
    """The fault of a pose; empty if there is none."""

    GOOD = ""
    NOT_FINITE = "pose not finite"
    NO_ATTITUDE = "pose without an attitude"
    FROZEN = "pose frozen"
    JUMPED = "pose jumped"
    TURNED = "attitude jumped"
    TOO_FAST = "velocity jumped"
    SPUN = "body rates jumped"
    APART = "motion capture and the vehicle's own estimate disagree"
    NOT_ITS_WAY = "estimated position and velocity disagree"
    NOT_ITS_THRUST = "estimated velocity disagrees with thrust and attitude"
    NOT_ITS_CLIMB = "estimated climb disagrees with the accelerometer"
    NOT_ITS_TURN = "estimated attitude disagrees with the gyroscope"
    DRIFTS = "estimated velocity drifts: neither thrust nor drag explains it, as they do teammates'"
    NOT_ITS_RATES = "the gyroscope disagrees with the body rates that were sent"


@dataclass(frozen=True)
class PoseLimits:
    """Bounds of a believable pose. The first four are physics, the others accuracies of
    measurements.

    A bound is an accuracy plus the most that can have happened since the last good
    pose. While its source tells something, however wrong, what can happen grows for
    `horizon` seconds only: by then the vehicle is landed by reckoning, level and slow,
    and `drift` is what that may lose. While nothing is heard, anything can happen.
    """

    acceleration: float
    """The vehicle's largest (m/s^2), see `Airframe.acceleration`."""
    angular_acceleration: float
    """The vehicle's largest (rad/s^2)."""
    body_rate: float = math.radians(2000.0)
    """Full scale of the gyroscope on board (rad/s); BMI088 data sheet."""
    horizon: float = 0.06
    """Time (s) for which a vehicle is flown without a good pose;
    `SafetySettings.pose_timeout`.
    """
    drift: float = 0.25
    """Error of the reckoned velocity (m/s): 1.5 degrees of tilt for a second."""
    position: float = 0.03
    """Error of one position (m): three times what `locSrv.extPosStdDev` is set to on
    board.
    """
    velocity: float = 0.3
    """Error of one velocity (m/s): half of a position's error in the time constant of
    the velocity's low-pass.
    """
    angle: float = 0.15
    """Error of one attitude (rad)."""
    rate: float = 1.0
    """Error of one body rate (rad/s): propellers shake the gyroscope."""
    unit: float = 0.02
    """The most by which a quaternion's length may differ from one: 9 bits a component on board."""
    apart: float = 0.1
    """Distance (m) between motion capture and the own estimate: 5 standard errors of
    two of .01 m, and 30 ms at 1 m/s.
    """
    turned: float = math.radians(20.0)
    """Angle (rad) between them: a body marked by hand stands within 10 degrees, as does
    an estimate of the yaw.
    """


def judge(
    pose: Pose, last: Pose | None, unseen: float, limits: PoseLimits, prediction: Pose | None = None
) -> Verdict:
    """The fault of a pose.

    Args:
      pose: the newest.
      last: the last good one of the same source; None if there is none, as on the
      ground.
      unseen: for how long its source told nothing before it (s).
      limits: bounds.
      prediction: where reckoning has the vehicle by now; without it, where `last` leads.
    """
    # first what no comparison is true of: a NaN would pass all of the following
    if not all(map(math.isfinite, numbers_of(pose)[1:])):
        return Verdict.NOT_FINITE
    if abs(math.hypot(*pose.quaternion) - 1.0) > limits.unit:
        return Verdict.NO_ATTITUDE
    if math.hypot(*pose.body_rates) > limits.body_rate:
        return Verdict.SPUN
    if last is None:
        return Verdict.GOOD
    # a measurement has noise: identical numbers are one measurement sent again
    if pose[1:] == last[1:]:
        return Verdict.FROZEN
    prediction = prediction or moved_on(last, pose.time)
    dt = pose.time - last.time
    sudden = min(dt, max(unseen, limits.horizon))
    push = limits.acceleration
    twist = limits.angular_acceleration
    way = limits.position + limits.drift * dt + 0.5 * push * sudden**2
    if math.dist(pose.position, prediction.position) > way:
        return Verdict.JUMPED
    if math.dist(pose.velocity, prediction.velocity) > limits.velocity + push * sudden:
        return Verdict.TOO_FAST
    turn = limits.angle + 0.5 * twist * sudden**2
    if angle_between(pose.quaternion, prediction.quaternion) > turn:
        return Verdict.TURNED
    if math.dist(pose.body_rates, last.body_rates) > limits.rate + twist * sudden:
        return Verdict.SPUN
    return Verdict.GOOD


class PoseHistory(NamedTuple):
    """The history of one source of a vehicle's poses."""

    pose: Pose | None = None  # the last good one
    verdict: Verdict = Verdict.GOOD  # on the newest
    last_time: float = -math.inf  # s, when that was measured

    def fresh(self, time: float, limits: PoseLimits) -> bool:
        """True if its last good pose is new enough to fly by at `time` (s)."""
        return self.pose is not None and time - self.pose.time <= limits.horizon

    def update(
        self,
        pose: Pose | None,
        time: float,
        limits: PoseLimits,
        moving: bool,
        prediction: Pose | None,
    ) -> "PoseHistory":
        """The track after its source's newest pose at `time` (s).

        A pose that isn't newer than the last good one, or old, or from the future,
        changes nothing. Of a vehicle that isn't `moving` any pose is believed that is
        one. `prediction`: see `judge`; at any time.
        """
        last = self.pose
        if pose is None or not abs(time - pose.time) <= limits.horizon:
            return self
        if last is None or not moving:
            verdict = judge(pose, None, 0.0, limits)
        elif pose.time <= last.time:
            return self
        else:
            prediction = None if prediction is None else moved_on(prediction, pose.time)
            verdict = judge(
                pose, last, pose.time - max(self.last_time, last.time), limits, prediction
            )
        return PoseHistory(last if verdict else pose, verdict, pose.time)


def at_one_time(a: Pose, b: Pose) -> tuple[Pose, Pose]:
    """Both, moved on to the later one's time."""
    newer = max(a.time, b.time)
    return moved_on(a, newer), moved_on(b, newer)


def agree(capture: Pose, estimate: Pose, limits: PoseLimits) -> Verdict:
    """Compare motion capture with the vehicle's own estimate, at the later one's time."""
    capture, estimate = at_one_time(capture, estimate)
    is_near = math.dist(capture.position, estimate.position) <= limits.apart
    is_aligned = angle_between(capture.quaternion, estimate.quaternion) <= limits.turned
    return Verdict.GOOD if is_near and is_aligned else Verdict.APART


def follows(capture: Pose, estimate: Pose, limits: PoseLimits) -> bool:
    """True if the estimator on board may be given a pose of motion capture: errors explain the
    distance from its own, at the later one's time.

    An estimator that is told late or drifting poses takes their error for a velocity,
    by which it would have to land.
    """
    capture, estimate = at_one_time(capture, estimate)
    return math.dist(estimate.position, capture.position) <= limits.position


def angle_between(a, b) -> float:
    """The angle (rad) of the rotation between two unit quaternions wxyz."""
    # the absolute value, since q and -q are one attitude; cut, since rounding may leave
    # more than 1
    cosine = abs(sum(p * q for p, q in zip(a, b, strict=True)))
    return 2.0 * math.acos(min(cosine, 1.0))

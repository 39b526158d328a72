"""Judge whether a pose may be flown by: a measurement against what a vehicle can have done since
the last good one.

`judge` compares a pose with the last good one of the same source, `offset_of` motion capture with
the vehicle's own estimate. Both are pure. What they don't accept is a lost pose, whatever sent it.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from openjax.flying.controller import Pose, angle_between, moved_on, numbers_of


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
    """Time (s) for which a vehicle is flown without a good pose; `SafetySettings.pose_timeout`."""
    drift: float = 0.25
    """Error of the reckoned velocity (m/s): 1.5 degrees of tilt for a second."""
    position: float = 0.03
    """Error of one position (m): three times what `locSrv.extPosStdDev` is set to on board."""
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


class Offset(NamedTuple):
    """The distance of motion capture from the vehicle's own estimate."""

    distance: float  # m
    angle: float  # rad

    def is_agreement(self, limits: PoseLimits) -> bool:
        """True if both can be right."""
        return self.distance <= limits.apart and self.angle <= limits.turned

    def is_error(self, limits: PoseLimits) -> bool:
        """True if errors of one pose explain the distance, so that the estimator on board may
        be given it.

        An estimator that is told late or drifting poses takes their error for a velocity,
        by which it would have to land.
        """
        return self.distance <= limits.position


def offset_of(capture: Pose, estimate: Pose) -> Offset:
    """How far motion capture is from the vehicle's own estimate, at the later one's time."""
    newer = max(capture.time, estimate.time)
    capture = moved_on(capture, newer)
    estimate = moved_on(estimate, newer)
    return Offset(
        math.dist(capture.position, estimate.position),
        angle_between(capture.quaternion, estimate.quaternion),
    )

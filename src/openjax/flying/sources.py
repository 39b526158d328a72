"""One source of a vehicle's poses, its own estimates or motion capture: what it told, and how far
it is believed.

A pose is first judged by itself and by the last good one (`openjax.flying.judge`), then
with all before it, by what physics lets them add up to (`openjax.flying.innovations`).
A source that fails the second isn't believed any more in this flight.
"""

import math
from typing import NamedTuple

from openjax.flying.controller import Airframe, Pose, Vector, moved_on
from openjax.flying.innovations import Innovations
from openjax.flying.judge import PoseLimits, Verdict, judge
from openjax.flying.set_point import SetPoint, as_sent

SMOOTHING = 0.02
"""Time constant of the low-pass of velocities from motion capture (s)."""


class VehicleTick(NamedTuple):
    """One vehicle at one tick, as far as its sources must know."""

    time: float  # s
    limits: PoseLimits
    airframe: Airframe
    command: SetPoint  # the last that was sent, which has acted since
    moving: bool  # whether it may have left the place where it stood
    airborne: bool  # whether nothing but air carries it: then thrust tells its acceleration


class PoseSource(NamedTuple):
    """One source of a vehicle's poses up to now."""

    pose: Pose | None = None  # the last good one
    verdict: Verdict = Verdict.GOOD  # on the newest
    last_time: float = -math.inf  # s, when that was measured
    innovations: Innovations = Innovations()
    fault: str = ""  # why none of its poses is believed any more in this flight

    def fresh(self, tick: VehicleTick) -> bool:
        """True if its last good pose is new enough to fly by."""
        return self.pose is not None and tick.time - self.pose.time <= tick.limits.horizon

    def update(self, pose: Pose | None, tick: VehicleTick, prediction: Pose | None) -> "PoseSource":
        """The source after its newest pose.

        A pose that isn't newer than the last good one, or old, or from the future,
        changes nothing. Of a vehicle that isn't moving any pose is believed that is
        one. `prediction`: see `judge`; at any time.
        """
        last = self.pose
        limits = tick.limits
        if pose is None or not abs(tick.time - pose.time) <= limits.horizon:
            return self
        if last is None or not tick.moving:
            verdict = judge(pose, None, 0.0, limits)
        elif pose.time <= last.time:
            return self
        else:
            prediction = None if prediction is None else moved_on(prediction, pose.time)
            unseen = pose.time - max(self.last_time, last.time)
            verdict = judge(pose, last, unseen, limits, prediction)
        return self._replace(pose=last if verdict else pose, verdict=verdict, last_time=pose.time)

    def check_motion(
        self, newer: "PoseSource", tick: VehicleTick, force: Vector | None = None
    ) -> "PoseSource":
        """`newer`, which is this source after a pose, with that pose's innovations; without
        the pose, and not to be believed any more, if they contradict physics.

        `force`: of the accelerometer, see `Innovations.update`.
        """
        if not tick.airborne:
            return newer._replace(innovations=Innovations())
        if newer.pose is self.pose:
            return newer
        innovations = self.innovations.update(
            newer.pose, as_sent(tick.command), tick.airframe, bool(self.verdict), force
        )
        fault = innovations.verdict()
        if fault:
            newer = newer._replace(pose=self.pose, verdict=fault, fault=fault)
        return newer._replace(innovations=innovations)


def with_motion(pose: Pose, last: Pose | None, estimate: Pose | None) -> Pose:
    """A pose of motion capture with the velocity from differences, smoothed, and the body
    rates of the gyroscope, which the vehicle's own `estimate` holds.
    """
    if last is None or pose.time <= last.time:
        return pose if last is None else last
    if (pose.position, pose.quaternion) == (last.position, last.quaternion):
        return last._replace(time=pose.time)  # which is judged frozen
    step = pose.time - last.time
    # differences of poses that are off by a millimetre jump by .1 m/s at 100 Hz
    share = 1.0 - math.exp(-step / SMOOTHING)
    velocity = tuple(
        v + share * ((p - q) / step - v)
        for p, q, v in zip(pose.position, last.position, last.velocity, strict=True)
    )
    return pose._replace(
        velocity=velocity, body_rates=pose.body_rates if estimate is None else estimate.body_rates
    )

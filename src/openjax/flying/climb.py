"""Compare a vehicle's estimated climb with the one that its accelerometer feels.

A height that drifts together with its velocity looks like flight to thrust and attitude: the
floor's cushion, another vehicle's wake and an emptier battery accelerate by as much. The
accelerometer feels all of these. What it doesn't feel are its own offset, which is learnt in
flight, and an error of the attitude, which counts upwards only by its square. So what the estimate
climbs beyond it is summed up, smoothed over a pause in which clocks may differ, and bounded.

Along the ground the attitude's error counts in full, .17 m/s^2 a degree: there the accelerometer
tells no more than thrust does.
"""

import math
from typing import NamedTuple

from openjax.flying.controller import GRAVITY, Pose, Vector, up

WINDOW = 4.0
"""Over this time constant (s) is summed up."""
CALM = 0.3
"""Time constant of the sum's low-pass (s): accelerometer and estimate are sampled some
milliseconds apart, in sharp turns by .1 m/s."""
LONGEST = 0.025
"""After a longer pause (s) between two poses nobody knows what was felt."""
TRUSTED = 10.0
"""The offset is taken to be zero as surely as this time (s) would tell ..."""
LEARNT = 30.0
"""... and is learnt with this time constant (s) at last."""
BOUND = 0.16
"""Of the smoothed sum (m/s). In 24 public flights of a Crazyflie the largest was .14
(experiments/results/flying.md)."""


class Climb(NamedTuple):
    """The part of an estimate's climb that the accelerometer doesn't feel."""

    time: float = -math.inf  # s, of the last pose
    speed: float = 0.0  # m/s, upwards, of that
    # m/s^2, upwards, by the accelerometer; no number where it isn't known
    felt: float = math.nan
    offset: float = 0.0  # m/s^2, as learnt
    age: float = 0.0  # s, for how long
    total: float = 0.0  # m/s
    smooth: float = 0.0  # m/s, the sum's low-pass
    height: float = 0.0  # m, what the sum has added to the height

    def update(self, pose: Pose, force: Vector | None) -> "Climb":
        """With the next pose and the specific force (m/s^2, body) that is felt there.
        Where a pose or a force is missing, nothing changes.
        """
        dt = pose.time - self.time
        speed = pose.velocity[2]
        force_climb = math.nan if force is None else felt_climb(pose.quaternion, force)
        if not 0.0 < dt <= LONGEST or math.isnan(force_climb + self.felt):
            return self._replace(time=pose.time, speed=speed, felt=force_climb)
        beyond = speed - self.speed - dt * (0.5 * (force_climb + self.felt) + self.offset)
        age = self.age + dt
        decay = math.exp(-dt / WINDOW)
        total = decay * self.total + beyond
        return Climb(
            time=pose.time,
            speed=speed,
            felt=force_climb,
            offset=self.offset + beyond / min(age + TRUSTED, LEARNT),
            age=age,
            total=total,
            smooth=total + math.exp(-dt / CALM) * (self.smooth - total),
            height=decay * self.height + dt * total,
        )

    @property
    def contradicts(self) -> bool:
        """True if the estimate climbs or sinks as the accelerometer doesn't feel."""
        return abs(self.smooth) > BOUND


def felt_climb(quaternion, force: Vector) -> float:
    """World z (m/s^2) of the acceleration that a specific force (m/s^2, body) tells."""
    w, x, y, z = quaternion
    across = 2.0 * (x * z - w * y) * force[0] + 2.0 * (y * z + w * x) * force[1]
    return across + up(quaternion) * force[2] - GRAVITY

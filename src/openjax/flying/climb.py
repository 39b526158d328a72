"""Whether a vehicle's estimated climb is the one that its accelerometer feels.

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
TRUSTED = 10.0
"""The offset is taken to be zero as surely as this time (s) would tell ..."""
LEARNT = 30.0
"""... and is learnt with this time constant (s) at last."""
BOUND = 0.16
"""Of the smoothed sum (m/s). In 24 public flights of a Crazyflie the largest was .14
(`experiments.flying.climbs`)."""


class Climb(NamedTuple):
    """What of an estimate's climb the accelerometer doesn't feel."""

    felt: float | None = None
    """World z of the specific force at the last pose, less gravity (m/s^2); None: unknown."""
    offset: float = 0.0  # m/s^2, as learnt
    age: float = 0.0  # s, for how long
    summed: float = 0.0  # m/s
    smooth: float = 0.0  # m/s, the sum's low-pass
    height: float = 0.0  # m, what the sum has added to the height

    def after(self, last: Pose, pose: Pose, force: Vector | None) -> "Climb":
        """From one pose to the next, with the specific force (m/s^2, body) that is felt there. Of a
        time without one nothing is known: it changes nothing.
        """
        felt = None if force is None else felt_climb(pose.quaternion, force)
        if felt is None or self.felt is None:
            return self._replace(felt=felt)
        dt = pose.time - last.time
        gained = pose.velocity[2] - last.velocity[2]
        beyond = gained - dt * (0.5 * (felt + self.felt) + self.offset)
        age = self.age + dt
        kept = math.exp(-dt / WINDOW)
        summed = kept * self.summed + beyond
        return Climb(
            felt=felt,
            offset=self.offset + beyond / min(age + TRUSTED, LEARNT),
            age=age,
            summed=summed,
            smooth=summed + math.exp(-dt / CALM) * (self.smooth - summed),
            height=kept * self.height + dt * summed,
        )

    @property
    def contradicts(self) -> bool:
        """Whether the estimate climbs or sinks as the accelerometer doesn't feel."""
        return abs(self.smooth) > BOUND


def felt_climb(quaternion, force: Vector) -> float:
    """World z (m/s^2) of the acceleration that a specific force (m/s^2, body) tells."""
    w, x, y, z = quaternion
    across = 2.0 * (x * z - w * y) * force[0] + 2.0 * (y * z + w * x) * force[1]
    return across + up(quaternion) * force[2] - GRAVITY

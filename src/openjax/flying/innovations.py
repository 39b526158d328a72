"""Check a vehicle's own estimate against itself, its gyroscope, and what was sent.

A single pose says little: a drift of .3 m/s moves it by 3 mm. So what a pose adds to
the last one is compared with what it should add, and the differences, the innovations,
are summed up with a forgetting time (Mehra and Peschon 1971, "An innovations approach
to fault detection and diagnosis in dynamic systems", Automatica 7):

* the way, with the velocity that the same estimate tells;
* the change of velocity, with thrust and attitude;
* the turn, with the gyroscope;
* the gyroscope, with the body rates that were sent;
* the climb, with the accelerometer (`openjax.flying.climb`), where it is logged.

A drift along the ground, of position and velocity together, that sets in gently passes
all of them. Teammates tell some of these (`openjax.flying.drift`), a second source all.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from openjax.flying.climb import Climb
from openjax.flying.controller import Airframe, Pose, Vector, lift_acceleration
from openjax.flying.drift import Drift
from openjax.flying.judge import Verdict
from openjax.flying.set_point import RATES, SetPoint

ZERO = (0.0, 0.0, 0.0)


class Memory(NamedTuple):
    """The time constant over which an innovation is summed up, and its limit."""

    forgetting: float
    """Time constant (s)."""
    bound: float
    """In the innovation's unit."""


WAY = Memory(1.2, 0.095)
"""Of position against velocity (m): one is off the other by .08 m/s. Errors of 8 mm and
4 cm/s that have nothing to do with each other reach .09.
"""
SPEED = Memory(0.1, 0.2)
"""Of velocity against thrust (m/s): a disturbance of 2 m/s^2 that sets in at once, as
no drag does.
"""
RISING = 0.3
"""The same upwards (m/s), where the floor's cushion pushes."""
SINKING = 0.7
"""The same downwards (m/s), where the wake of another vehicle pushes: .2 N (Shi et al.
2020) on 30 g.
"""
STEP = 0.2
"""Of one pose's velocity against thrust (m/s): no wake pushes so much between two poses."""
TURN = Memory(1.0, 0.08)
"""Of attitude against gyroscope (rad): one is off the other by .08 rad/s."""
RATE = Memory(0.2, 1.5)
"""Mean difference of the gyroscope from the body rates that were sent (rad/s)."""
SETTLED = 0.3
"""Velocity isn't judged in a flight's first moments (s), in which it is learnt what
thrust doesn't explain: drag, wind or a weight that isn't known.
"""
BIAS = 3.0
"""From then on that is learnt with this time constant (s) only."""
RECENT = 0.5
"""How long (s) it is remembered by how much the velocity left what thrust explains: a
vehicle whose estimate is refused flies on without that.
"""
RATE_LAG = 0.04
"""Time constant of the rate loop (s)."""
LONGEST = 0.025
"""After a longer pause (s) between two poses nobody knows what happened: no innovation."""


class Innovations(NamedTuple):
    """The sums of one source of a vehicle's poses, and what the next ones are made of."""

    pose: Pose | None = None
    way: Vector = ZERO  # m, world
    step: Vector = ZERO  # m/s, world: what the newest pose adds to the next one
    speed: Vector = ZERO  # m/s, world
    recent: Vector = ZERO  # m/s, world: the same, remembered for longer
    turn: Vector = ZERO  # rad, body
    rate: Vector = ZERO  # rad/s, body
    # m/s^2, world: what thrust and attitude don't explain: drag, wind, an unknown weight
    bias: Vector = ZERO
    age: float = 0.0  # s, for how long that is learnt
    thrust: float = 0.0  # share of the maximum that the motors have reached
    rates: Vector = ZERO  # rad/s, that the rate loop should have reached
    # what neither thrust nor drag explains, of the level velocity
    drift: Drift = Drift()
    # what the accelerometer doesn't feel, of the upward velocity
    climb: Climb = Climb()

    def update(
        self,
        pose: Pose,
        command: SetPoint,
        airframe: Airframe,
        is_refused: bool = False,
        force: Vector | None = None,
    ) -> "Innovations":
        """With the next pose; `command` has acted since the last one.

        Args:
          is_refused: whether poses between them came and weren't believed. Then this
          one must follow from the last believable one, however long that is ago.
          force: specific force (m/s^2, body) that the accelerometer feels at the pose;
          None: it isn't known.
        """
        last = self.pose
        climb = self.climb.update(pose, force)
        longest = math.inf if is_refused else LONGEST
        if last is None or not 0.0 < pose.time - last.time <= longest:
            return self._restart(pose, command, climb)
        dt = pose.time - last.time
        thrust, rates = self._response(pose, command, airframe, dt)
        # the trapezoidal rule: exact for an acceleration that stays
        mean = _towards(last.velocity, pose.velocity, 0.5)
        way = _difference(_difference(pose.position, last.position), _times(dt, mean))
        beyond_thrust = _beyond_thrust(last, pose, thrust, airframe)
        residual = _difference(beyond_thrust, self.bias)
        step = _times(dt, residual)
        turn = _turn_beyond_gyroscope(last, pose)
        error = _difference(pose.body_rates, rates)
        age = self.age + dt
        return Innovations(
            pose=pose,
            way=_leaky_sum(self.way, way, dt, WAY.forgetting),
            step=step,
            speed=_leaky_sum(self.speed, step, dt, SPEED.forgetting),
            recent=_leaky_sum(self.recent, step, dt, RECENT),
            turn=_leaky_sum(self.turn, turn, dt, TURN.forgetting),
            rate=_towards(self.rate, error, _share(dt, RATE.forgetting)),
            bias=_sum(self.bias, _times(dt / min(age, BIAS), residual)),
            age=age,
            thrust=thrust,
            rates=rates,
            drift=self.drift.update(beyond_thrust, mean, dt),
            climb=climb,
        )

    def _restart(self, pose, command, climb):
        """The same sums, to go on from a pose that doesn't follow from the last one."""
        return self._replace(pose=pose, thrust=command.thrust, rates=pose.body_rates, climb=climb)

    def _response(self, pose, command, airframe, dt):
        """Thrust and body rates that motors and rate loop have made of a command after
        `dt` s, as two low-passes.
        """
        share = _share(dt, airframe.motor_time_constant)
        thrust = self.thrust + share * (command.thrust - self.thrust)
        request = (
            (command.roll, command.pitch, command.yaw_rate)
            if command.mode == RATES
            else pose.body_rates
        )
        return thrust, _towards(self.rates, request, _share(dt, RATE_LAG))

    def corrected_pose(self) -> Pose:
        """The newest pose without what was summed up: where the vehicle is if what it
        is compared with is right.
        """
        way = self.way
        recent = self.recent
        if self.climb.contradicts:
            way = (*way[:2], self.climb.height)
            recent = (*recent[:2], self.climb.total)
        return self.pose._replace(
            position=_difference(self.pose.position, way),
            velocity=_difference(self.pose.velocity, recent),
        )

    def verdict(self) -> Verdict:
        """The contradiction of the estimate; good if there is none."""
        *level, rise = self.speed
        is_push = math.hypot(*level) > SPEED.bound or not -SINKING < rise < RISING
        if math.hypot(*self.way) > WAY.bound:
            return Verdict.NOT_ITS_WAY
        if self.age > SETTLED and (is_push or math.hypot(*self.step) > STEP):
            return Verdict.NOT_ITS_THRUST
        if self.climb.contradicts:
            return Verdict.NOT_ITS_CLIMB
        if math.hypot(*self.turn) > TURN.bound:
            return Verdict.NOT_ITS_TURN
        if math.hypot(*self.rate) > RATE.bound:
            return Verdict.NOT_ITS_RATES
        return Verdict.GOOD


def turn_between(start: Sequence[float], end: Sequence[float]) -> Vector:
    """The small rotation (rad, body) from one attitude wxyz to another."""
    # the vector part of conj(before) * after, which is half of a small rotation; `sign`
    # also chooses between q and -q
    a, b, c, d = start
    w, x, y, z = end
    scalar = a * w + b * x + c * y + d * z
    sign = math.copysign(2.0, scalar)
    return (
        sign * (a * x - b * w - c * z + d * y),
        sign * (a * y + b * z - c * w - d * x),
        sign * (a * z - b * y + c * x - d * w),
    )


def _beyond_thrust(last: Pose, pose: Pose, thrust: float, airframe: Airframe) -> Vector:
    """The acceleration (m/s^2, world) from one pose to the next that a thrust at the
    latter's attitude doesn't explain.
    """
    lift = lift_acceleration(pose.quaternion, thrust / airframe.hover_thrust)
    gain = _times(1.0 / (pose.time - last.time), _difference(pose.velocity, last.velocity))
    return _difference(gain, lift)


def _turn_beyond_gyroscope(last: Pose, pose: Pose) -> Vector:
    """The turn (rad, body) from one pose to the next that the gyroscope doesn't tell."""
    mean = _towards(last.body_rates, pose.body_rates, 0.5)
    turn = turn_between(last.quaternion, pose.quaternion)
    return _difference(turn, _times(pose.time - last.time, mean))


def _share(dt: float, time_constant: float) -> float:
    """The share of the way to its input that a low-pass goes in `dt` (s)."""
    return -math.expm1(-dt / time_constant)


def _leaky_sum(total: Vector, part: Vector, dt: float, forgetting: float) -> Vector:
    return _sum(_times(math.exp(-dt / forgetting), total), part)


def _sum(a: Vector, b: Vector) -> Vector:
    return tuple(p + q for p, q in zip(a, b, strict=True))


def _difference(a: Vector, b: Vector) -> Vector:
    return tuple(p - q for p, q in zip(a, b, strict=True))


def _times(number: float, a: Vector) -> Vector:
    return tuple(number * p for p in a)


def _towards(a: Vector, b: Vector, share: float) -> Vector:
    return tuple(p + share * (q - p) for p, q in zip(a, b, strict=True))

"""Flying to a point: position and velocity to a set-point, for take-off, waiting,
landing and getting out of trouble.

A cascade of proportional loops; what it asks for beyond hovering is small, so it needs
no more of the vehicle than the thrust at which it hovers. Plain numbers instead of
arrays: it runs a few times per tick, where JAX would cost more.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from openjax.flying.set_point import ANGLES, RATES, SetPoint

Vector = tuple[float, float, float]
GRAVITY = 9.81
"""m/s^2"""
POSITION_GAIN = 2.5
"""Velocity asked for per position error (1/s)."""
VELOCITY_GAIN = 5.0
"""Acceleration asked for per velocity error (1/s)."""
ANGLE_GAIN = 8.0
"""Body rate asked for per angle error (1/s), where body rates are sent."""
YAW_GAIN = 1.5
"""Yaw rate asked for per yaw (1/s)."""
TILT_LIMIT = math.radians(35.0)
"""Of what is asked for (rad)."""
CLIMB_LIMIT = 4.0
"""Largest vertical acceleration asked for (m/s^2)."""
NEAR = 0.06
"""A vehicle has arrived this close to its target (m) ..."""
SLOW = 0.15
"""... and at less than this speed (m/s)."""


class Pose(NamedTuple):
    """A vehicle's pose; world frame, SI units, quaternion wxyz body to world."""

    time: float  # s, host clock, when it was measured
    position: Vector
    velocity: Vector
    quaternion: tuple[float, float, float, float]
    body_rates: Vector = (0.0, 0.0, 0.0)


def numbers_of(pose: Pose) -> tuple[float, ...]:
    """The 14 numbers of a pose, in the order of its fields."""
    return (pose.time, *pose.position, *pose.velocity, *pose.quaternion, *pose.body_rates)


def pose_of(numbers: Sequence[float]) -> Pose:
    """The pose of these 14 numbers."""
    return Pose(
        time=numbers[0],
        position=tuple(numbers[1:4]),
        velocity=tuple(numbers[4:7]),
        quaternion=tuple(numbers[7:11]),
        body_rates=tuple(numbers[11:14]),
    )


@dataclass(frozen=True)
class Airframe:
    """The numbers of a vehicle that flying needs; all of them follow from its parameters."""

    hover_thrust: float
    """Share of the maximal thrust at which it hovers."""
    angular_acceleration: float
    """The largest about roll or pitch (rad/s^2)."""
    motor_time_constant: float
    """s"""

    @property
    def acceleration(self) -> float:
        """The largest there is (m/s^2): full thrust downwards."""
        return GRAVITY * (1.0 + 1.0 / self.hover_thrust)


def airframe_of(vehicle) -> Airframe:
    """The airframe of an `openjax.vehicle.Vehicle`."""
    thrust = float(vehicle.thrust_constant) * float(vehicle.max_rotor_speed) ** 2
    arm = float(abs(vehicle.rotor_position[:, :2]).min())
    return Airframe(
        hover_thrust=float(vehicle.mass * vehicle.gravity) / (4.0 * thrust),
        # two rotors at full thrust, those on the other side at none
        angular_acceleration=2.0 * thrust * arm / float(min(vehicle.inertia[:2])),
        motor_time_constant=float(vehicle.motor_time_constant),
    )


@functools.cache
def nominal_airframe() -> Airframe:
    """The airframe of the vehicle in the package."""
    from openjax.vehicle import load_vehicle

    return airframe_of(load_vehicle())


def roll_pitch_yaw(quaternion) -> Vector:
    """Angles (rad) of a quaternion wxyz, in the order yaw, pitch, roll about moving axes."""
    w, x, y, z = quaternion
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def yaw_only(quaternion) -> tuple[float, float, float, float]:
    """The attitude (4,) wxyz without roll and pitch."""
    w, _, _, z = quaternion
    size = math.hypot(w, z)
    return (w / size, 0.0, 0.0, z / size) if size > 1e-6 else (1.0, 0.0, 0.0, 0.0)


def body_axis(quaternion) -> Vector:
    """The body's z axis, along which it pushes, in the world."""
    w, x, y, z = quaternion
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), up(quaternion)


def up(quaternion) -> float:
    """World z component of the body's z axis."""
    _, x, y, _ = quaternion
    return 1.0 - 2.0 * (x * x + y * y)


def level_acceleration(quaternion) -> Vector:
    """The acceleration (m/s^2, world) of a vehicle at this attitude that holds its height."""
    # at more than 72 degrees no rotor holds it; .3 keeps the number finite
    return lift_acceleration(quaternion, 1.0 / max(up(quaternion), 0.3))


def lift_acceleration(quaternion, lift: float) -> Vector:
    """The acceleration (m/s^2, world) at an attitude (4,) with a thrust that is `lift`
    times the weight.
    """
    x, y, z = body_axis(quaternion)
    return lift * GRAVITY * x, lift * GRAVITY * y, lift * GRAVITY * z - GRAVITY


def moved_on(pose: Pose, time: float) -> Pose:
    """The pose at `time` (s) if velocity and body rates have stayed what they were."""
    age = time - pose.time
    if age == 0.0:
        return pose
    position = tuple(p + age * v for p, v in zip(pose.position, pose.velocity, strict=True))
    quaternion = turned_on(pose.quaternion, pose.body_rates, age)
    return pose._replace(time=time, position=position, quaternion=quaternion)


def turned_on(quaternion, rates: Vector, duration: float) -> tuple[float, float, float, float]:
    """The attitude, wxyz, after turning at body rates (rad/s) for `duration` (s)."""
    # to first order: nothing turns far in the hundredths of a second between two poses
    w, x, y, z = quaternion
    a, b, c = (0.5 * duration * rate for rate in rates)
    turn = (
        w - x * a - y * b - z * c,
        x + w * a + y * c - z * b,
        y + w * b + z * a - x * c,
        z + w * c + x * b - y * a,
    )
    size = math.sqrt(sum(q * q for q in turn))
    return tuple(q / size for q in turn)


def angle_between(a, b) -> float:
    """The angle (rad) of the rotation between two unit quaternions wxyz."""
    # the absolute value, since q and -q are one attitude; cut, since rounding may leave more than 1
    cosine = abs(sum(p * q for p, q in zip(a, b, strict=True)))
    return 2.0 * math.acos(min(cosine, 1.0))


def wanted_velocity(position: Vector, target: Vector, speed: float) -> Vector:
    """The velocity that leads from `position` to `target`, of at most `speed` (m/s)."""
    velocity = [POSITION_GAIN * (t - p) for t, p in zip(target, position, strict=True)]
    size = math.sqrt(sum(v * v for v in velocity))
    share = min(1.0, speed / size) if size > 0 else 1.0
    return tuple(v * share for v in velocity)


def wanted_acceleration(velocity: Vector, target: Vector) -> Vector:
    """The acceleration (m/s^2, world) that leads from a velocity to the `target`,
    within the tilt limit.
    """
    ax, ay, az = (VELOCITY_GAIN * (w - v) for w, v in zip(target, velocity, strict=True))
    # height first: the tilt that is left for the rest follows from the lift
    az = min(max(az, -CLIMB_LIMIT), CLIMB_LIMIT)
    level = math.hypot(ax, ay)
    most = (GRAVITY + az) * math.tan(TILT_LIMIT)
    share = most / level if level > most else 1.0
    return ax * share, ay * share, az


def accelerate(
    quaternion, acceleration: Vector, airframe: Airframe, trim: float, mode: int = ANGLES
) -> SetPoint:
    """The set-point for an acceleration (m/s^2, world) at an attitude, yaw to zero.

    The thrust is what of it the body's axis can do at present: a vehicle that still
    leans elsewhere first turns, then pushes (Lee, Leok, McClamroch 2010, "Geometric
    tracking control of a quadrotor UAV on SE(3)"). `trim` is added to the hover thrust.
    `mode` RATES tracks the angles here instead of on board.
    """
    ax, ay, az = acceleration
    roll, pitch, yaw = roll_pitch_yaw(quaternion)
    forward = ax * math.cos(yaw) + ay * math.sin(yaw)
    lateral = -ax * math.sin(yaw) + ay * math.cos(yaw)
    lift = math.sqrt((GRAVITY + az) ** 2 + forward**2 + lateral**2)
    # a positive pitch leans the thrust forward, a positive roll to the right
    wanted_pitch = math.atan2(forward, GRAVITY + az)
    wanted_roll = math.asin(min(max(-lateral / lift, -1.0), 1.0))
    along = sum(a * b for a, b in zip(body_axis(quaternion), (ax, ay, GRAVITY + az), strict=True))
    thrust = (airframe.hover_thrust + trim) * max(along, 0.0) / GRAVITY
    yaw_rate = -YAW_GAIN * yaw
    # where rates are sent nobody on board tracks the angles
    if mode == RATES:
        return SetPoint(
            RATES,
            ANGLE_GAIN * (wanted_roll - roll),
            ANGLE_GAIN * (wanted_pitch - pitch),
            yaw_rate,
            thrust,
        )
    return SetPoint(ANGLES, wanted_roll, wanted_pitch, yaw_rate, thrust)


def follow_velocity(pose: Pose, velocity: Vector, airframe: Airframe, trim: float) -> SetPoint:
    """The set-point of body rates that leads from `pose` to a velocity (m/s, world)."""
    acceleration = wanted_acceleration(pose.velocity, velocity)
    return accelerate(pose.quaternion, acceleration, airframe, trim, RATES)


def has_arrived(pose: Pose, target: Vector) -> bool:
    """True if a vehicle waits at its target."""
    is_near = math.dist(pose.position, target) < NEAR
    return is_near and math.hypot(*pose.velocity) < SLOW

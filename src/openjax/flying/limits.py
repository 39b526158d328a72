"""The limits of a flight: what an action may ask for within them, where a vehicle may stop, turn
back, part, wait.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from openjax.flying.controller import Airframe, Pose, Vector, level_acceleration
from openjax.flying.set_point import RATES, SetPoint
from openjax.ranges import Interval, check_intervals
from openjax.vehicle.arena import Arena

APART = 0.35
"""Waiting vehicles keep this distance (m)."""


@dataclass(frozen=True)
class SafetySettings:
    """Limits of a flight."""

    arena_radius: Annotated[float, Interval("[0.3, 1000]")] = Arena.radius
    """No vehicle is let out of a cylinder of this radius (m)."""
    arena_height: Annotated[float, Interval("[0.6, 1000]")] = Arena.height
    """Nor above this (m)."""
    floor: Annotated[float, Interval("[0, 100]")] = 0.12
    """Nor, in pursuit, below this (m)."""
    outside: Annotated[float, Interval("[0, 100]")] = 0.3
    """Farther out than this (m) something is wrong: all land."""
    separation: Annotated[float, Interval("[0, 10]")] = 0.16
    """Vehicles in pursuit that couldn't stop at this distance (m) any more brake and part. 0
    switches it off.
    """
    speed_limit: Annotated[float, Interval("(0, 100]")] = 2.5
    """Faster than this (m/s) something is wrong: all land."""
    tilt_limit: Annotated[float, Interval("(0, 180]")] = 50.0
    """More tilted than this (degrees) something is wrong: all land."""
    tumble_time: Annotated[float, Interval("[0, 10]")] = 0.1
    """Upside down for longer (s): motors off."""
    braking: Annotated[float, Interval("(0, 100]")] = 5.0
    """Deceleration that is counted on to stop within the arena (m/s^2)."""
    reaction: Annotated[float, Interval("(0, 10]")] = 0.12
    """Time constant with which the acceleration follows what is asked for (s)."""
    pose_timeout: Annotated[float, Interval("(0, 60]")] = 0.06
    """Without a good pose for longer (s) a vehicle is flown by reckoning no more: it lands."""
    link_timeout: Annotated[float, Interval("(0, 60]")] = 0.3
    """A link silent for longer (s) is gone."""
    action_timeout: Annotated[float, Interval("(0, 60]")] = 0.035
    """Without a new action of the policy for longer (s): all stop where they are."""
    battery_low: Annotated[float, Interval("[0, 100]")] = 3.2
    """Voltage under load, for `battery_time`, at which a vehicle lands (V)."""
    battery_time: Annotated[float, Interval("[0, 60]")] = 0.5
    battery_start: Annotated[float, Interval("[0, 100]")] = 3.7
    """No vehicle takes off with less, measured without load (V)."""
    stand: Annotated[float, Interval("(0, 1000]")] = 0.15
    """No vehicle takes off farther than this (m) from below its start."""
    lift: Annotated[float, Interval("(0, 1]")] = 0.1
    """Height of the test lift (m)."""
    lift_time: Annotated[float, Interval("(0, 60]")] = 2.0
    """It must be done by then (s)."""
    hold_time: Annotated[float, Interval("[0, 600]")] = 0.5
    """How long vehicles wait after a trouble before they land (s)."""
    transfer_speed: Annotated[float, Interval("(0, 10]")] = 0.5
    """On the way to the start (m/s)."""
    landing_speed: Annotated[float, Interval("(0, 10]")] = 0.4
    """m/s."""

    def __post_init__(self):
        check_intervals(self, "safety.")

    @property
    def landing_time(self) -> float:
        """A landing that takes longer (s) ends with the motors off: by then a vehicle that began at
        the highest place that is allowed is near the floor, whatever its pose says.
        """
        return (self.arena_height + self.outside) / self.landing_speed


def stopping_point(
    settings: SafetySettings, pose: Pose, acceleration: Vector | None = None
) -> Vector:
    """Where a vehicle comes to rest that brakes now (m): its acceleration fades with the time
    constant `reaction`, and as slowly the braking sets in.

    `acceleration`: at present (m/s^2, world); that of level flight at its tilt, if it isn't known.
    """
    lag = settings.reaction
    present = acceleration or level_acceleration(pose.quaternion)
    velocity = [
        v + lag * a for v, a in zip(pose.velocity, present, strict=True)
    ]  # once it has faded
    time = lag + math.hypot(*velocity) / (2.0 * settings.braking)
    return tuple(
        p + time * v - lag**2 * a for p, v, a in zip(pose.position, velocity, present, strict=True)
    )


def fence_velocity(
    settings: SafetySettings, pose: Pose, acceleration: Vector | None = None
) -> Vector | None:
    """The velocity (m/s) that keeps a vehicle in the arena; None while it could still stop inside.
    See `stopping_point`.
    """
    x, y, z = stopping_point(settings, pose, acceleration)
    out = math.hypot(x, y)
    outside = out > settings.arena_radius
    above = z > settings.arena_height
    below = z < settings.floor
    if not (outside or above or below):
        return None
    vx, vy, _ = pose.velocity
    if outside:
        vx = -0.5 * x / out
        vy = -0.5 * y / out
    return vx, vy, -0.4 if above else 0.4 if below else 0.0


def parting_velocity(
    settings: SafetySettings, i: int, poses: Sequence[Pose | None]
) -> Vector | None:
    """The velocity (m/s) that keeps vehicle i off the others; None while all could still stop
    apart.

    Two vehicles that close in at `c` and both brake at `braking` need `c * reaction + c**2 / (4 *
    braking)` to stop.
    """
    own = poses[i]
    wanted = None
    for j, other in enumerate(poses):
        if j == i or other is None:
            continue
        distance = math.dist(own.position, other.position)
        if distance < 1e-6:
            continue
        away = tuple((p - q) / distance for p, q in zip(own.position, other.position, strict=True))
        closing = sum(
            a * (w - v) for a, v, w in zip(away, own.velocity, other.velocity, strict=True)
        )
        stopping = max(closing, 0.0) * (
            settings.reaction + max(closing, 0.0) / (4.0 * settings.braking)
        )
        lack = settings.separation - (distance - stopping)
        if lack > 0.0:
            push = 0.5 * max(closing, 0.0) + min(lack / settings.reaction, 0.5)
            wanted = tuple(w + push * a for w, a in zip(wanted or own.velocity, away, strict=True))
    return wanted


def within_reach(action: SetPoint, sent: SetPoint, airframe: Airframe, dt: float) -> SetPoint:
    """The action within its bounds, and no farther from what was sent `dt` (s) before than the
    vehicle can follow.

    Its rates can't change faster than its largest angular acceleration, its thrust than its motors'
    time constant.
    """

    def near(value, old, room):
        return min(max(value, old - room), old + room) if sent.mode == RATES else value

    turn = airframe.angular_acceleration * dt
    lift = dt / airframe.motor_time_constant
    rates = (
        near(min(max(new, -math.pi), math.pi), old, turn)
        for new, old in (
            (action.roll, sent.roll),
            (action.pitch, sent.pitch),
            (action.yaw_rate, sent.yaw_rate),
        )
    )
    return SetPoint(RATES, *rates, near(min(max(action.thrust, 0.0), 1.0), sent.thrust, lift))


def resting_places(
    settings: SafetySettings, pillars: Sequence[Vector], poses: Sequence[Pose | None]
) -> list[Vector]:
    """Where vehicles may wait or land: near where they would stop, inside, off the pillars, apart
    (m).

    Args:
      settings: limits.
      pillars: x, y, radius (m).
      poses: of the vehicles; None for one that was never seen.
    """
    places = [
        stopping_point(settings, pose) if pose is not None else (0.0, 0.0, 0.0) for pose in poses
    ]
    reach = settings.arena_radius - 0.15
    low = 0.3
    high = settings.arena_height - 0.3
    places = [(x, y, min(max(z, low), high)) for x, y, z in places]
    for _ in range(20):
        moved = []
        for i, place in enumerate(places):
            for x, y, radius in pillars:
                place = _pushed(place, (x, y), radius + 0.15)
            for j, other in enumerate(places):
                if j != i:
                    place = _pushed(place, other, APART, 0.5)
            inside = min(1.0, reach / max(math.hypot(*place[:2]), 1e-6))
            moved.append((place[0] * inside, place[1] * inside, place[2]))
        if all(math.dist(a, b) < 1e-4 for a, b in zip(moved, places, strict=True)):
            break
        places = moved
    return places


def _pushed(place, other, distance, share=1.0) -> Vector:
    """The place (x, y, z) moved on its level by a share of what it lacks of a distance from
    another.
    """
    dx = place[0] - other[0]
    dy = place[1] - other[1]
    apart = math.hypot(dx, dy)
    if apart >= distance:
        return place
    dx, dy = (dx / apart, dy / apart) if apart > 1e-6 else (1.0, 0.0)
    lack = share * (distance - apart)
    return place[0] + lack * dx, place[1] + lack * dy, place[2]

"""Places where a vehicle may stop, turn back, part and wait, and the commands that it can follow.

Plain mechanics of poses, limits in `SafetySettings`: nothing here knows who flies a
vehicle, or why. That is `openjax.flying.safety`'s.
"""

import math
from collections.abc import Sequence

from openjax.flying.controller import Airframe, Pose, Vector, level_acceleration
from openjax.flying.set_point import RATES, SetPoint
from openjax.flying.state import SafetySettings

APART = 0.35
"""Waiting vehicles keep this distance (m)."""
CLEARANCE = 0.15
"""And this from pillars and from the wall (m): a hand's breadth."""
HEADROOM = 0.3
"""And this from floor and ceiling (m)."""
WALL_RETURN = 0.5
"""Speed (m/s) at which a vehicle is turned back from the wall ..."""
CEILING_RETURN = 0.4
"""... and from ceiling or floor."""
FASTEST_PUSH = 0.5
"""Vehicles that are too close part by at most this (m/s) beyond what they close in by."""
ROUNDS = 20
"""Resting places are pushed apart at most so often: crowded ones may have no answer."""


def stopping_point(
    settings: SafetySettings, pose: Pose, acceleration: Vector | None = None
) -> Vector:
    """The point at which a vehicle that brakes now comes to rest (m): its acceleration fades with
    the time constant `reaction`, and as slowly the braking sets in.

    `acceleration`: at present (m/s^2, world); that of level flight at its tilt, if it isn't known.
    """
    lag = settings.reaction
    present = acceleration or level_acceleration(pose.quaternion)
    # once the acceleration has faded
    velocity = [v + lag * a for v, a in zip(pose.velocity, present, strict=True)]
    time = lag + math.hypot(*velocity) / (2.0 * settings.braking)
    moving = zip(pose.position, velocity, present, strict=True)
    return tuple(p + time * v - lag**2 * a for p, v, a in moving)


def fence_velocity(
    settings: SafetySettings, pose: Pose, acceleration: Vector | None = None
) -> Vector | None:
    """The velocity (m/s) that keeps a vehicle in the arena; None while it could still
    stop inside. See `stopping_point`.
    """
    x, y, z = stopping_point(settings, pose, acceleration)
    out = math.hypot(x, y)
    outside = out > settings.arena_radius
    above = z > settings.arena_height
    below = z < settings.floor
    if not (outside or above or below):
        return None
    vx, vy, _ = pose.velocity
    # straight towards the axis: what leads along the wall is given up
    if outside:
        vx = -WALL_RETURN * x / out
        vy = -WALL_RETURN * y / out
    return vx, vy, -CEILING_RETURN if above else CEILING_RETURN if below else 0.0


def parting_velocity(
    settings: SafetySettings, i: int, poses: Sequence[Pose | None]
) -> Vector | None:
    """The velocity (m/s) that keeps vehicle i off the others; None while all could
    still stop apart.

    Two vehicles that close in at `c` and both brake at `braking` need `c * reaction +
    c**2 / (4 * braking)` to stop.
    """
    pose = poses[i]
    velocity = None
    for j, other in enumerate(poses):
        if j == i or other is None:
            continue
        distance = math.dist(pose.position, other.position)
        if distance < 1e-6:  # no way leads apart from there
            continue
        away = tuple((p - q) / distance for p, q in zip(pose.position, other.position, strict=True))
        approach = zip(away, pose.velocity, other.velocity, strict=True)
        # along the line between them; what moves apart needs no room
        closing = max(sum(a * (w - v) for a, v, w in approach), 0.0)
        stopping = closing * (settings.reaction + closing / (4.0 * settings.braking))
        lack = settings.separation - (distance - stopping)
        if lack > 0.0:
            # half of the approach: the other brakes the other half
            push = 0.5 * closing + min(lack / settings.reaction, FASTEST_PUSH)
            velocity = tuple(
                w + push * a for w, a in zip(velocity or pose.velocity, away, strict=True)
            )
    return velocity


def safe_velocity(
    settings: SafetySettings, i: int, poses: Sequence[Pose | None], acceleration: Vector
) -> Vector | None:
    """The velocity (m/s) that keeps vehicle i in the arena and off the others; None while
    neither is in danger. `acceleration`: its own at present (m/s^2, world).
    """
    pose = poses[i]
    parting = parting_velocity(settings, i, poses) if settings.separation > 0.0 else None
    # who makes room for another mustn't leave the arena for that
    aim = pose if parting is None else pose._replace(velocity=parting)
    return (
        fence_velocity(settings, pose, acceleration)
        or fence_velocity(settings, aim, acceleration)
        or parting
    )


def within_reach(action: SetPoint, previous: SetPoint, airframe: Airframe, dt: float) -> SetPoint:
    """The action within its bounds, and no farther from what was sent `dt` (s) before
    than the vehicle can follow.

    Its rates can't change faster than its largest angular acceleration, its thrust than
    its motors' time constant.
    """

    def near(value, old, room):
        return min(max(value, old - room), old + room) if previous.mode == RATES else value

    def rate(value, old):
        return near(min(max(value, -math.pi), math.pi), old, turn)

    turn = airframe.angular_acceleration * dt
    lift = dt / airframe.motor_time_constant
    return SetPoint(
        mode=RATES,
        roll=rate(action.roll, previous.roll),
        pitch=rate(action.pitch, previous.pitch),
        yaw_rate=rate(action.yaw_rate, previous.yaw_rate),
        thrust=near(min(max(action.thrust, 0.0), 1.0), previous.thrust, lift),
    )


def resting_places(
    settings: SafetySettings, pillars: Sequence[Vector], poses: Sequence[Pose | None]
) -> list[Vector]:
    """Places where vehicles may wait or land: near where they would stop, inside, off the pillars,
    apart (m).

    Args:
      settings: limits.
      pillars: x, y, radius (m).
      poses: of the vehicles; None for one that was never seen.
    """
    nowhere = (0.0, 0.0, 0.0)
    stops = [nowhere if pose is None else stopping_point(settings, pose) for pose in poses]
    reach = settings.arena_radius - CLEARANCE
    low = HEADROOM
    high = settings.arena_height - HEADROOM
    places = [(x, y, min(max(z, low), high)) for x, y, z in stops]
    # each push may undo another, so all are repeated until nothing moves
    for _ in range(ROUNDS):
        next_places = []
        for i, place in enumerate(places):
            for x, y, radius in pillars:
                place = _push_away(place, (x, y), radius + CLEARANCE)
            for j, other in enumerate(places):
                if j != i:
                    # each of the two goes half of the way, from one place in opposite directions
                    place = _push_away(place, other, APART, 0.5, 1.0 if i < j else -1.0)
            # the wall last, so that no push leads out of the arena
            inside = min(1.0, reach / max(math.hypot(*place[:2]), 1e-6))
            next_places.append((place[0] * inside, place[1] * inside, place[2]))
        if all(math.dist(a, b) < 1e-4 for a, b in zip(next_places, places, strict=True)):
            break
        places = next_places
    return places


def _push_away(place, other, distance, share=1.0, direction=1.0) -> Vector:
    """The place (x, y, z) moved on its level by a share of what it lacks of a distance from
    another; out of the very same place along x, forwards or backwards by `direction`.
    """
    dx = place[0] - other[0]
    dy = place[1] - other[1]
    distance_now = math.hypot(dx, dy)
    if distance_now >= distance:
        return place
    dx, dy = (dx / distance_now, dy / distance_now) if distance_now > 1e-6 else (direction, 0.0)
    lack = share * (distance - distance_now)
    return place[0] + lack * dx, place[1] + lack * dy, place[2]

"""The commands of a vehicle in each mode: by the policy within the limits, or by the controller.
`openjax.flying.safety` decides the mode.
"""

import math

from openjax.flying.controller import (
    Vector,
    accelerate,
    follow_velocity,
    has_arrived,
    lift_acceleration,
    turned_on,
    wanted_acceleration,
    wanted_velocity,
    yaw_only,
)
from openjax.flying.limits import APART, safe_velocity, within_reach
from openjax.flying.set_point import ANGLES, LEAST_THRUST, MOTORS_OFF, SetPoint
from openjax.flying.state import FLYING, Drone, Mode, State

LOW = 0.05
"""Below this height (m) a landing settles."""
SETTLING = 0.75
"""A landing ends level for so long (s): from .4 m it comes down at 1.1 m/s. So far may
the floor be from where it is thought.
"""
SETTLING_LIFT = 0.85
"""It is then carried by this share of its weight."""
TRIM_GAIN = 0.25
"""Share of full thrust by which a climb that is off by 1 m/s for 1 s changes the trim."""
TRIM_LIMIT = 0.15
"""Largest trim, as a share of full thrust."""


def steer(state: State, i: int, action: SetPoint | None) -> Drone:
    """Vehicle i after this tick, with its set-point. `action`: the policy's, where there is one."""
    drone = state.drones[i]._replace(sent=MOTORS_OFF)
    time = state.time
    if drone.mode not in FLYING or drone.estimate is None:
        return drone
    if drone.mode is Mode.SETTLE and time - drone.since > SETTLING:
        return drone.to(Mode.LANDED, time)
    # the last centimetres go level: nothing on board knows exactly where the floor is
    if drone.mode is Mode.LAND and _is_low(state, drone):
        drone = drone.to(Mode.SETTLE, time)
    if drone.mode is Mode.SETTLE:
        lift = SETTLING_LIFT * (state.airframe.hover_thrust + drone.trim)
        return drone._replace(sent=SetPoint(ANGLES, thrust=lift))
    if drone.mode is Mode.PURSUIT and action is not None:
        return drone._replace(sent=_pursue(state, drone, i, action))
    return _go(state, drone, i)


def _is_low(state, drone) -> bool:
    """True if a landing is near the floor, or long enough on the way."""
    overdue = state.time - drone.since > state.settings.landing_time
    return overdue or drone.estimate.position[2] < LOW


def _pursue(state, drone, i, action) -> SetPoint:
    """The policy's action, or what keeps the drone in the arena and off the others."""
    pose = drone.estimate
    sent = state.drones[i].sent
    # until its motors have followed it turns on
    attitude = turned_on(pose.quaternion, pose.body_rates, state.airframe.motor_time_constant)
    lift = max(sent.thrust, LEAST_THRUST) / state.airframe.hover_thrust
    present = lift_acceleration(attitude, lift)
    poses = [d.estimate if d.mode in FLYING else None for d in state.drones]
    velocity = safe_velocity(state.settings, i, poses, present)
    if velocity is None:
        return within_reach(action, sent, state.airframe, state.dt)
    return follow_velocity(pose, velocity, state.airframe, drone.trim)


def _go(state, drone, i) -> Drone:
    """The drone on its way to its anchor, or waiting there, by the controller."""
    estimate = drone.estimate
    airframe = state.airframe
    velocity = _target_velocity(state, drone, i)
    acceleration = wanted_acceleration(estimate.velocity, velocity)
    attitude = estimate.quaternion
    if state.time - drone.seen > state.settings.pose_timeout:
        # by reckoning: the vehicle does what it is asked for, and is level else
        share = min(state.dt / state.settings.reaction, 1.0)
        change = zip(drone.acceleration, acceleration, strict=True)
        drone = drone._replace(acceleration=tuple(a + share * (b - a) for a, b in change))
        attitude = yaw_only(attitude)
    else:
        # not lower: on the floor a vehicle that doesn't climb isn't too heavy
        if estimate.position[2] > (0.02 if drone.mode is Mode.LIFT else 0.1):
            error = min(max(velocity[2] - estimate.velocity[2], -0.3), 0.3)
            trim = min(max(drone.trim + TRIM_GAIN * state.dt * error, -TRIM_LIMIT), TRIM_LIMIT)
            drone = drone._replace(trim=trim)
        if drone.mode is Mode.TRANSFER and has_arrived(estimate, drone.anchor):
            drone = drone.to(Mode.READY, state.time)
    return drone._replace(sent=accelerate(attitude, acceleration, airframe, drone.trim, ANGLES))


def _target_velocity(state, drone, i) -> Vector:
    """The velocity (m/s) that the drone's mode asks for."""
    position = drone.estimate.position
    settings = state.settings
    if drone.mode is Mode.LAND:
        x, y, _ = wanted_velocity(position, (*drone.anchor[:2], position[2]), 0.5)
        slower = 0.6 if position[2] < 0.2 else 1.0
        return x, y, -slower * settings.landing_speed
    x, y, z = wanted_velocity(position, drone.anchor, settings.transfer_speed)
    if drone.mode is not Mode.TRANSFER:
        return x, y, z
    if position[2] < 0.2:  # straight up first
        x = y = 0.0
    if math.dist(position, drone.anchor) < 0.3:  # starts may be close to each other
        return x, y, z
    for j, other in enumerate(state.drones):  # around each other, to the right
        if j == i or other.estimate is None or other.mode not in FLYING:
            continue
        dx = position[0] - other.estimate.position[0]
        dy = position[1] - other.estimate.position[1]
        distance = math.hypot(dx, dy)
        if 1e-6 < distance < APART:
            push = (APART - distance) / distance * 2.0
            x = x + push * (dx + dy)
            y = y + push * (dy - dx)
    return x, y, z

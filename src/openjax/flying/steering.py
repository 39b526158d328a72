"""How a vehicle is flown in each mode: by the policy within its limits, or by the controller."""

import math

from openjax.flying.controller import (
    Vector,
    accelerate,
    lift_acceleration,
    turned_on,
    up,
    wanted_acceleration,
    wanted_velocity,
)
from openjax.flying.limits import APART, fence_velocity, parting_velocity, within_reach
from openjax.flying.set_point import ANGLES, LEAST_THRUST, MOTORS_OFF, RATES, SetPoint
from openjax.flying.state import FLYING, Drone, Mode, PoseSample, State

LOW = 0.05
"""Below this height (m) a landing settles."""
SETTLING = 0.75
SETTLING_LIFT = 0.85
"""A landing ends level, with this share of its weight, for so long (s): from .4 m it comes down at
1.1 m/s. So far may the floor be from where it is thought.
"""
TRIM_GAIN = 0.25
TRIM_LIMIT = 0.15


def steer(state: State, i: int, action: SetPoint | None, sample: PoseSample) -> Drone:
    """Vehicle i after this tick, with its set-point. `action`: the policy's, where there is one."""
    drone = _watched(state, state.drones[i], sample)._replace(sent=MOTORS_OFF)
    now = state.time
    if drone.mode not in FLYING or drone.estimate is None:
        return drone
    if drone.mode is Mode.SETTLE and now - drone.since > SETTLING:
        return drone.to(Mode.LANDED, now)
    if drone.mode is Mode.LAND and _is_low(state, drone):
        drone = drone.to(Mode.SETTLE, now)
    if drone.mode is Mode.SETTLE:
        lift = SETTLING_LIFT * (state.airframe.hover_thrust + drone.trim)
        return drone._replace(sent=SetPoint(ANGLES, thrust=lift))
    if drone.mode is Mode.PURSUIT and action is not None:
        return drone._replace(sent=_pursue(state, drone, i, action))
    return _go(state, drone, i)


def _watched(state, drone, sample) -> Drone:
    """The drone with since when its battery is low and since when it is upside down."""

    def since(before, is_so):
        return (state.time if before is None else before) if is_so else None

    low = sample.voltage < state.settings.battery_low  # an unknown voltage is not low
    over = drone.estimate is not None and up(drone.estimate.quaternion) < 0.0
    return drone._replace(
        low_since=since(drone.low_since, low), over_since=since(drone.over_since, over)
    )


def _is_low(state, drone) -> bool:
    """Whether a landing is near the floor, or long enough on the way."""
    late = state.time - drone.since > state.settings.landing_time
    return late or drone.estimate.position[2] < LOW


def _pursue(state, drone, i, action) -> SetPoint:
    """The policy's action, or what keeps the drone in the arena and off the others."""
    settings = state.settings
    estimate = drone.estimate
    parting = None
    if settings.separation > 0.0:
        poses = [d.estimate if d.mode in FLYING else None for d in state.drones]
        parting = parting_velocity(settings, i, poses)
    aimed = estimate if parting is None else estimate._replace(velocity=parting)
    sent = state.drones[i].sent
    # until its motors have followed it turns on
    turned = turned_on(estimate.quaternion, estimate.body_rates, state.airframe.motor_time_constant)
    present = lift_acceleration(
        turned, max(sent.thrust, LEAST_THRUST) / state.airframe.hover_thrust
    )
    wanted = (
        fence_velocity(settings, estimate, present)
        or fence_velocity(settings, aimed, present)
        or parting
    )
    if wanted is None:
        return within_reach(action, sent, state.airframe, state.dt)
    acceleration = wanted_acceleration(estimate.velocity, wanted)
    return accelerate(estimate.quaternion, acceleration, state.airframe, drone.trim, RATES)


def _go(state, drone, i) -> Drone:
    """The drone on its way to its anchor, or waiting there, by the controller."""
    estimate = drone.estimate
    airframe = state.airframe
    wanted = _wanted(state, drone, i)
    acceleration = wanted_acceleration(estimate.velocity, wanted)
    attitude = estimate.quaternion
    if state.time - drone.seen > state.settings.pose_timeout:
        # by reckoning: the vehicle does what it is asked for, and is level else
        share = min(state.dt / state.settings.reaction, 1.0)
        lagged = tuple(
            a + share * (b - a) for a, b in zip(drone.acceleration, acceleration, strict=True)
        )
        drone = drone._replace(acceleration=lagged)
        attitude = _yaw_only(attitude)
    else:
        if estimate.position[2] > (0.02 if drone.mode is Mode.LIFT else 0.1):
            error = min(max(wanted[2] - estimate.velocity[2], -0.3), 0.3)
            trim = min(max(drone.trim + TRIM_GAIN * state.dt * error, -TRIM_LIMIT), TRIM_LIMIT)
            drone = drone._replace(trim=trim)
        if drone.mode is Mode.TRANSFER and _arrived(estimate, drone.anchor):
            drone = drone.to(Mode.READY, state.time)
    return drone._replace(sent=accelerate(attitude, acceleration, airframe, drone.trim, ANGLES))


def _wanted(state, drone, i) -> Vector:
    """The velocity (m/s) that the drone's mode asks for."""
    position = drone.estimate.position
    settings = state.settings
    if drone.mode is Mode.LAND:
        x, y, _ = wanted_velocity(position, (*drone.anchor[:2], position[2]), 0.5)
        return x, y, -(0.6 if position[2] < 0.2 else 1.0) * settings.landing_speed
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


def _arrived(estimate, target) -> bool:
    return (
        math.dist(estimate.position, target) < 0.06
        and math.dist(estimate.velocity, (0.0, 0.0, 0.0)) < 0.15
    )


def _yaw_only(quaternion):
    w, _, _, z = quaternion
    size = math.hypot(w, z)
    return (w / size, 0.0, 0.0, z / size) if size > 1e-6 else (1.0, 0.0, 0.0, 0.0)

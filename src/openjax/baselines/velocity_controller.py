"""The velocity controller: a point mass's velocity as thrust and body rates of the real
vehicle.

A desired velocity becomes an acceleration, that a direction and size of the thrust, and
the body's z axis is turned there: the translational half of the geometric controller of
Lee, Leok and McClamroch (2010), with the attitude loop left to the vehicle's own rate
controller. A function of the observation alone, without memory.
"""

import jax
import jax.numpy as jnp

from openjax.baselines.surroundings import QUATERNION, VELOCITY, Craft, length
from openjax.errors import UserError
from openjax.pursuit import Observation
from openjax.pursuit.observation import rotation_axes
from openjax.vehicle.vectors import unit

VELOCITY_GAIN = 6.0
"""1/s, velocity error to acceleration: slower than the attitude, whose lag is that of
the motors (25 ms) and of the turn.
"""
ATTITUDE_GAIN = 15.0
"""1/s, error of the body's z axis (rad) to body rates."""
LARGEST_TILT = 0.7
"""Tangent of the largest tilt that is commanded (35 degrees)."""
YAW_GAIN = 2.0
"""1/s, yaw (rad) to yaw rate: the nose is turned to the world's x axis."""
CLIMB_LIMITS = (-0.5, 0.3)
"""Vertical acceleration in units of gravity; thrust over weight is 1.44 with the
commanded thrust cut at 0.9.
"""
GRAVITY = 9.81
"""m/s^2"""
SLOWEST_CONTROL = 0.03
"""Control step (s) beyond which the attitude loop would ring."""
HEAVIEST = 0.8
"""Share of the thrust that hovers beyond which there is no room to climb and brake."""


def check_flyable(name: str, craft: Craft, time_step: float) -> None:
    """Raises UserError where the controller can't fly this craft with control steps of
    `time_step` (s) for `name`.
    """
    if time_step > SLOWEST_CONTROL:
        raise UserError(
            f"{name}: its velocity controller can't fly control steps of {time_step} s; "
            f"at most {SLOWEST_CONTROL} s are possible"
        )
    if craft.hover_thrust > HEAVIEST:
        raise UserError(
            f"{name}: a vehicle that hovers at {craft.hover_thrust:.2f} of its thrust leaves its "
            f"velocity controller no room; at most {HEAVIEST} is possible"
        )


def velocity_action(
    craft: Craft, observation: Observation, desired_velocity: jax.Array
) -> jax.Array:
    """(..., N, 4) action in -1..1 (thrust, body rates) that flies the desired
    velocities (..., N, 3) in m/s, world.
    """
    self_state = observation.self_state
    body_x, body_z = rotation_axes(self_state[..., QUATERNION])
    # in units of the weight
    thrust = VELOCITY_GAIN / GRAVITY * (desired_velocity - self_state[..., VELOCITY])
    rise = 1.0 + jnp.clip(thrust[..., 2:], *CLIMB_LIMITS)
    # height before the rest: what a limited tilt can't do is left of the horizontal
    # part
    lean = thrust[..., :2]
    lean = lean * jnp.minimum(1.0, LARGEST_TILT * rise / length(lean))
    thrust = jnp.concatenate([lean, rise], axis=-1)
    # as much of it as the body's axis can do at present: who leans elsewhere turns
    # first
    share = craft.hover_thrust * jnp.sum(thrust * body_z, axis=-1)
    # the cross product is the axis about which to turn, as long as the sine of the
    # angle
    turn = ATTITUDE_GAIN * jnp.cross(body_z, unit(thrust))
    yaw = jnp.arctan2(body_x[..., 1], body_x[..., 0])
    roll_rate = _dot(turn, body_x)
    pitch_rate = _dot(turn, jnp.cross(body_z, body_x))
    rates = jnp.stack([roll_rate, pitch_rate, -YAW_GAIN * yaw], axis=-1)
    # an action of -1 is no thrust, of 1 all of it; rates are in units of pi rad/s
    action = jnp.concatenate([2.0 * share[..., None] - 1.0, rates / jnp.pi], axis=-1)
    return jnp.clip(action, -1.0, 1.0)


def _dot(a, b):
    return jnp.sum(a * b, axis=-1)

"""Differences from flight to flight and moment to moment: gusts, sensor noise, commands and poses
that come unevenly.

Effects like those of `openjax.vehicle.effects`, for flying with only: they're random,
so no diagnosis looks for them.
"""

import jax
import jax.numpy as jnp

from openjax.vehicle.effects.effect import Effect, Parameter
from openjax.vehicle.parameters import hover_command
from openjax.vehicle.rigid_body import quaternion_multiply, rotate_inverse

LONGEST_JITTER = 0.01
"""s, one control step: a command that comes later than the next one is lost rather than
late.
"""


def _draw(memory):
    """A key to draw with, and the memory's next one. Keys are stored as plain numbers,
    so that a state is arrays alone.
    """
    draw, carry = jax.random.split(jax.random.wrap_key_data(memory["key"]))
    return draw, jax.random.key_data(carry)


def _jitter_memory(vehicle, state, dt, key):
    return {
        "previous": hover_command(vehicle, state.position.dtype),
        "key": jax.random.key_data(key),
    }


def _jitter_command(parameters, memory, command, context):
    """A command that comes late by part of a step: the mean of the old and the new one
    over that step.
    """
    draw, key = _draw(memory)
    delay = parameters["longest"] * jax.random.uniform(draw, (), command.dtype)
    part = jnp.clip(delay / context.dt, 0.0, 1.0)
    return command + part * (memory["previous"] - command), {"previous": command, "key": key}


COMMAND_JITTER = Effect(
    name="command_jitter",
    description="each command comes later by a time drawn for it",
    parameters={
        "longest": Parameter(
            "s",
            0.0,
            (0.0, LONGEST_JITTER),
            "2.4 GHz radio: a packet waits for its slot or is sent again",
        )
    },
    command=_jitter_command,
    initial_memory=_jitter_memory,
    random=True,
)


def _gust_wrench(parameters, context):
    """Forces in the world that rise and fall, at rates without a common period."""
    # no ratio of small whole numbers, so that no flight sees the three axes repeat
    # together
    ratios = jnp.array([1.0, 1.31, 0.77], context.velocity.dtype)
    angle = parameters["rate"] * context.air_time * ratios
    size = jnp.stack([parameters["x"], parameters["y"], parameters["z"]])
    force = rotate_inverse(context.quaternion, size * jnp.sin(angle + parameters["phase"]))
    return force, jnp.zeros_like(force)


_INDOORS = "unsteady force on hovering Crazyflies indoors, some 1-3 % of their weight"

GUST = Effect(
    name="gust",
    description="slow forces of unsteady air, one sine along each axis",
    parameters={
        "x": Parameter("N", 0.0, (-0.02, 0.02), _INDOORS, "amplitude"),
        "y": Parameter("N", 0.0, (-0.02, 0.02), _INDOORS, "amplitude"),
        "z": Parameter("N", 0.0, (-0.02, 0.02), _INDOORS, "amplitude"),
        "rate": Parameter("rad/s", 2.0, (0.5, 6.0), _INDOORS, "of the sine along x"),
        "phase": Parameter("rad", 0.0, (0.0, 6.28), "any"),
    },
    wrench=_gust_wrench,
)


def _noise_memory(vehicle, state, dt, key):
    dtype = state.position.dtype
    return {
        # of position, velocity and attitude
        "noise": jnp.zeros(9, dtype),
        "late": jnp.zeros((), dtype),
        "key": jax.random.key_data(key),
    }


def _noise_record(memory, state):
    draw, key = _draw(memory)
    dtype = memory["noise"].dtype
    normal_key, late_key = jax.random.split(draw)
    return {
        "noise": jax.random.normal(normal_key, (9,), dtype),
        "late": jax.random.uniform(late_key, (), dtype),
        "key": key,
    }


def _noise_sensor(parameters, memory, state):
    """White noise on pose and velocity; a pose that is older by up to `jitter` is where
    the drone was then.
    """
    position, velocity, angle = jnp.split(memory["noise"], 3)
    # what was measured `late` ago is shown as if it were measured now
    delay = parameters["jitter"] * memory["late"]
    # half of a small rotation vector is the vector part of its quaternion
    turn = 0.5 * (parameters["attitude"] * angle - delay * state.body_rates)
    quaternion = quaternion_multiply(
        state.quaternion, jnp.concatenate([jnp.ones_like(turn[:1]), turn])
    )
    return state.replace(
        position=state.position - delay * state.velocity + parameters["position"] * position,
        velocity=state.velocity + parameters["velocity"] * velocity,
        quaternion=quaternion * jax.lax.rsqrt(jnp.sum(quaternion * quaternion)),
    )


_CAPTURE = "motion capture of Crazyflies: about 1 mm, .5 degrees; velocity by differences at 100 Hz"

POSE_NOISE = Effect(
    # effects act by name: after the latency, which shows true poses of earlier moments
    name="view_noise",
    description="the pose that the off-board controller sees is noisy and unevenly late",
    parameters={
        "position": Parameter("m", 0.0, (0.0, 0.003), _CAPTURE),
        "velocity": Parameter("m/s", 0.0, (0.0, 0.05), _CAPTURE),
        "attitude": Parameter("rad", 0.0, (0.0, 0.02), _CAPTURE, "about each axis"),
        "jitter": Parameter(
            "s", 0.0, (0.0, LONGEST_JITTER), "motion capture, filtering and network"
        ),
    },
    sensor=_noise_sensor,
    record=_noise_record,
    initial_memory=_noise_memory,
    random=True,
)

DISTURBANCES = {effect.name: effect for effect in (COMMAND_JITTER, GUST, POSE_NOISE)}

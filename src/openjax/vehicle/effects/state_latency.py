"""The pose that the off-board controller sees is old; gyroscope and motors on board are
not.
"""

import jax.numpy as jnp

from openjax.vehicle.effects.delay import fill, look_back, push
from openjax.vehicle.effects.effect import NOT_NEGATIVE, Card, Effect, Fitted, Parameter


def _pose(state):
    return jnp.concatenate([state.position, state.quaternion, state.velocity])


def initial_memory(vehicle, state, dt, key):
    """A memory in which the drone had been here before. The step is remembered, since `sensor` has
    no other way to know it.
    """
    return {"pose": fill(_pose(state), dt), "dt": jnp.asarray(dt, state.position.dtype)}


def record(memory, state):
    """Quaternions q and -q are the same attitude: the one nearer to the last is kept,
    so they can be averaged.
    """
    pose = _pose(state)
    # a pose is position (3), quaternion (4) and velocity (3) in one row
    same = jnp.sum(state.quaternion * memory["pose"][0, 3:7]) >= 0.0
    sign = jnp.where(same, 1.0, -1.0).astype(pose.dtype)
    pose = pose.at[3:7].multiply(sign)
    return {**memory, "pose": push(memory["pose"], pose)}


def sensor(parameters, memory, state):
    """The state with the pose of `delay` seconds ago."""
    pose = look_back(memory["pose"], parameters["delay"], memory["dt"])
    # the mean of two attitudes is shorter than either
    quaternion = pose[3:7] / jnp.linalg.norm(pose[3:7])
    return state.replace(position=pose[:3], quaternion=quaternion, velocity=pose[7:])


EFFECT = Effect(
    name="state_latency",
    description="position, attitude and velocity are seen a fixed time late",
    formula=r"(p, q, v)_{\mathrm{seen}}(t) = (p, q, v)(t - \Delta)",
    parameters={
        "delay": Parameter(
            "s", 0.0, (0.004, 0.06), "motion capture, filtering and network", domain=NOT_NEGATIVE
        )
    },
    sensor=sensor,
    record=record,
    initial_memory=initial_memory,
    card=Card(
        path="estimator",
        fitted=(Fitted("delay", mean=0.0, spread=0.02, start=0.0, step=0.0005, sample=0.03),),
        next_flight="fast roll and pitch manoeuvres with pose and gyroscope logged.",
    ),
)

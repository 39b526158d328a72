"""The observation of a judge's evader: all of the world's state, as numbers in axes of its own.

The x axis points away from the arena's axis, so that a game that is turned looks the
same; with `world_axes` it is the world's. Pursuers and pillars are sorted by their
distance. Where tasks have an evader's speed and a capture radius of their own, it knows
these, too: one network plays them all.
"""

import jax
import jax.numpy as jnp

from openjax.pursuit import PursuitSettings, PursuitState
from openjax.pursuit.observation import rotation_axes
from openjax.pursuit.task import capture_radius, evader_speed

TINY = 1e-9
NEAR = 3.0
"""Capture radii by which offsets are measured: what matters is near, however wide the
arena is.
"""
_EVADER = 14
_PURSUER = 13
_NO_PILLAR = (4.0, 0.0, 0.0, 0.0)
_NO_PURSUER = (4.0, 0.0, 0.0, 4.0, *[0.0] * 9)
"""What is sensed of a slot that isn't in use: a pillar, a pursuer far away."""
USUAL_RADIUS = 0.3
"""By which a task's own capture radius is measured (m): the paper's."""


def sense(
    settings: PursuitSettings, state: PursuitState, world_axes: jax.Array, slots: int | None = None
) -> jax.Array:
    """(F,) float32, of the order of one, of one world.

    Args:
      settings: the game.
      state: of one world.
      world_axes: () bool.
      slots: of pillars that are sensed, at least the game's; None: as many.
    """
    axes = _axes(state.evader_position, world_axes)
    pillars = _pillars(settings, state, axes)
    missing = (slots or len(pillars)) - len(pillars)
    absent = jnp.broadcast_to(jnp.array(_NO_PILLAR), (missing, len(_NO_PILLAR)))
    parts = [
        _evader(settings, state, axes),
        _pursuers(settings, state, axes).ravel(),
        jnp.concatenate([pillars, absent]).ravel(),
    ]
    task = state.task
    if task.evader_speed is not None:
        parts.append(task.evader_speed[None] / settings.max_speed)
    if task.capture_radius is not None:
        parts.append(task.capture_radius[None] / USUAL_RADIUS)
    if task.arena_radius is not None:
        parts.append(task.arena_radius[None])
    return jnp.concatenate(parts)


def number_of_senses(pursuers: int, slots: int) -> int:
    """F for as many pursuers and pillar slots, in a game whose tasks have no numbers of
    their own.
    """
    return _EVADER + _PURSUER * pursuers + len(_NO_PILLAR) * slots


def to_world(velocity: jax.Array, state: PursuitState, world_axes: jax.Array) -> jax.Array:
    """(3,) in the world of a velocity (3,) in the evader's axes."""
    axes = _axes(state.evader_position, world_axes)
    return velocity @ axes


def _axes(position, world_axes):
    """(3, 3) rows: the evader's axes in the world."""
    radius = jnp.sqrt(jnp.sum(position[:2] ** 2) + TINY)
    # on the axis there is no outward direction
    outward = jnp.where(world_axes | (radius < 1e-3), jnp.array([1.0, 0.0]), position[:2] / radius)
    cos, sin = outward
    return jnp.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _length(vector):
    return jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True) + TINY)


def _evader(settings, state, axes):
    """(14,) own place and velocity, the time, and where the pursuers saw it last."""
    position = state.evader_position
    radius = _length(position[:2])
    middle = jnp.array(settings.middle, jnp.float32)
    time = state.step / settings.episode_length
    return jnp.concatenate(
        [
            axes @ (position - middle) / settings.arena_radius,
            1.0 - radius / settings.arena_radius,
            position[2:] / settings.arena_height,
            axes @ state.evader_velocity / evader_speed(settings, state.task),
            axes @ (state.last_seen - position) / settings.arena_radius,
            jnp.stack([state.seen.astype(jnp.float32), time, 1.0 - time]),
        ]
    )


def _pursuers(settings, state, axes):
    """(N, 13), the nearest first: where each is, how it flies, where its rotors pull,
    if it sees the evader; empty slots are far away.
    """
    radius = capture_radius(settings, state.task)
    near = NEAR * radius
    offset = state.drones.position - state.evader_position
    distance = _length(offset)
    thrust = rotation_axes(state.drones.quaternion)[1]
    velocity = state.drones.velocity / settings.max_speed
    closing = -jnp.sum(offset / distance * velocity, axis=-1, keepdims=True)
    rows = jnp.concatenate(
        [
            offset @ axes.T / near,
            distance / near,
            radius / jnp.maximum(distance, radius / 2),
            velocity @ axes.T,
            closing,
            thrust @ axes.T,
            state.in_sight[:, None].astype(jnp.float32),
        ],
        axis=-1,
    )
    if state.active is not None:
        # where they are parked is no number of the order of one
        rows = jnp.where(state.active[:, None], rows, jnp.array(_NO_PURSUER))
    return rows[jnp.argsort(distance[:, 0])]


def _pillars(settings, state, axes):
    """(P, 4), the nearest first: where each is, how far its surface, if it is there."""
    task = state.task
    offset = task.pillar_position - state.evader_position[:2]
    active = task.pillar_active[:, None]
    gap = _length(offset) - settings.pillar_radius
    near = jnp.exp(-jnp.maximum(gap, 0.0) / settings.pillar_radius)
    scale = NEAR * capture_radius(settings, task)
    rows = jnp.concatenate([offset @ axes[:2, :2].T / scale, near], axis=-1)
    rows = jnp.concatenate([rows, jnp.ones_like(near)], axis=-1)
    rows = jnp.where(active, rows, jnp.array(_NO_PILLAR))
    return rows[jnp.argsort(jnp.where(active, gap, jnp.inf)[:, 0])]

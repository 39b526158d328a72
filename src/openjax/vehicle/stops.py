"""Solid things, cheaply: once per step, drones are put back out of what they have sunk
into and lose their approach.

For learning, where a touch ends what the episode is worth anyhow; `mjx` stops a drone
at the surface itself.
"""

import jax.numpy as jnp

from openjax.vehicle.arena import Arena
from openjax.vehicle.shapes import Active, Pillars
from openjax.vehicle.solids import DRONE_RADIUS
from openjax.vehicle.state import DroneState


def stop(
    arena: Arena, drones: DroneState, pillar_position: Pillars, pillar_active: Active
) -> DroneState:
    """`drones` (leading axis N) out of the floor, pillars (P, 2) m in use (P,) and one
    another; no friction, no bounce.
    """
    position = drones.position
    velocity = drones.velocity
    # a pillar gives way to nobody, so the drone goes the whole depth; of two drones
    # each goes half
    if pillar_position.shape[0]:
        away = position[:, None, :2] - pillar_position[None]
        position, velocity = _push(
            position, velocity, away, arena.pillar_radius + DRONE_RADIUS, pillar_active[None], 1.0
        )
    if position.shape[0] > 1:
        offset = position[:, None] - position[None]
        others = ~jnp.eye(position.shape[0], dtype=bool)
        moving = velocity[:, None] - velocity[None]
        position, velocity = _push(
            position, velocity, offset, 2 * DRONE_RADIUS, others, 0.5, moving
        )
    # the floor comes last: whatever pushed a drone before, it ends above it
    low = position[:, 2] < DRONE_RADIUS
    height = jnp.maximum(position[:, 2], DRONE_RADIUS)
    fall = jnp.where(low, jnp.maximum(velocity[:, 2], 0.0), velocity[:, 2])
    return drones.replace(
        position=position.at[:, 2].set(height), velocity=velocity.at[:, 2].set(fall)
    )


def _push(position, velocity, away, reach, solid, share, moving=None):
    """Move drones out of things at `away` (N, M, 2 or 3) from them, by their `share` of
    the depth and of the approach.
    """
    size = away.shape[-1]
    moving = velocity[:, None, :size] if moving is None else moving
    # the root keeps a slope where a drone is in the middle of a pillar
    distance = jnp.sqrt(jnp.sum(away * away, axis=-1) + 1e-12)
    normal = away / distance[..., None]
    hit = solid & (distance < reach)
    depth = jnp.where(hit, share * (reach - distance), 0.0)
    # only what goes inwards is taken off: who leaves already keeps its velocity
    approach = jnp.where(hit, share * jnp.minimum(jnp.sum(normal * moving, axis=-1), 0.0), 0.0)
    shift = jnp.sum(depth[..., None] * normal, axis=1)
    change = jnp.sum(approach[..., None] * normal, axis=1)
    return position.at[:, :size].add(shift), velocity.at[:, :size].add(-change)

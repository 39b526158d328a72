"""Solid things around a drone: the floor, vertical pillars, the other drones; and how contact with them acts.

A test of present positions would let a drone sink in by the way of one step before anything stops it. So MJX
is shown each thing moved along the present normal of contact to where its surface will be, seen from the
drone, at the end of the step if nothing intervened. A contact then stops the drone at the surface, in the
step in which it would have passed it. While one thing is hit, whatever else is near is shown as just
touching: it may not be approached faster because of that impact, which keeps a drone from being squeezed
through a gap narrower than itself.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

DRONE_RADIUS = 0.05  # m, the solid sphere of a drone
PILLAR_RADIUS = 0.1  # m
PILLAR_HEIGHT = 1.2  # m, of the cylindrical part, which stands on the floor; rounded above
PARKED = -100.0  # m, height of a pillar that isn't there

# Contacts in MuJoCo's direct form: acceleration along the normal >= -stiffness * gap - damping * speed,
# `gap` being the
# one at the end of the step. (stiffness in 1/dt^2, damping in 1/dt, impedance: the share of that which is
# enforced.)
# Fixed things: together they cancel the approach in one step and close 0.4 of the gap, below the half at
# which a
# resting drone would chatter. Other drones: each of the pair takes half of the approach, an inelastic impact
# of equal
# masses that keeps their momentum; a low impedance, since the other gives way too.
_FIXED = (0.4, 0.6, 0.99)
_DRONE = (0.5, 0.0, 0.5)

_NEAR = 0.04  # m, gap within which a thing counts as near: the way of a fast drone in one step
_TOUCHING = -1e-6  # m, gap at which a contact acts but doesn't push


def solids_xml(n_pillars: int, n_others: int, dt: float) -> tuple[str, str]:
    """MJCF of the shapes (floor, pillars, other drones) and of their contact pairs with the geom "drone"."""
    shapes = ['<geom name="floor" type="plane" size="0 0 1"/>']
    pairs = [("floor", _FIXED)]
    for k in range(n_pillars):
        shapes.append(f'<geom name="pillar_{k}" type="capsule" size="{PILLAR_RADIUS} {PILLAR_HEIGHT / 2}"/>')
        pairs.append((f"pillar_{k}", _FIXED))
    for k in range(n_others):
        shapes.append(f'<geom name="other_{k}" type="sphere" size="{DRONE_RADIUS}"/>')
        pairs.append((f"other_{k}", _DRONE))
    contacts = (
        f'<pair geom1="drone" geom2="{name}" condim="1" '
        f'solref="{-stiffness / dt**2} {-damping / dt}" solimp="{impedance} {impedance} 0.001"/>'
        for name, (stiffness, damping, impedance) in pairs
    )
    return "".join(shapes), "".join(contacts)


def others(n: int) -> np.ndarray:
    """(n, n - 1) indices of the other drones, for each of n."""
    return np.array([[j for j in range(n) if j != i] for i in range(n)], int).reshape(n, n - 1)


def place_solids(position, velocity, pillar_position, pillar_active, dt) -> jax.Array:
    """Where each drone's shapes are shown to it for a step of dt seconds, (N, 1 + P + N - 1, 3) m.

    position and velocity (N, 3) of the drones, pillar_position (P, 2) m, pillar_active (P,). The shapes are
    in the order of `solids_xml`.
    """
    n, p = position.shape[0], pillar_position.shape[0]
    dtype = position.dtype
    height = jnp.where(pillar_active.astype(bool), PILLAR_HEIGHT / 2, PARKED).astype(dtype)
    pillars = jnp.concatenate([pillar_position.astype(dtype), height[:, None]], axis=1)
    radius = np.r_[DRONE_RADIUS, np.full(p, PILLAR_RADIUS + DRONE_RADIUS), np.full(n - 1, 2 * DRONE_RADIUS)]
    radius = jnp.asarray(radius, dtype)
    flat = jnp.array([1, 1, 0], dtype)

    def seen_by_one(position, velocity, other_position, other_velocity):
        half = PILLAR_HEIGHT / 2
        level = jnp.clip(position[2] - height, -half, half) + height
        axes = jnp.concatenate([pillars[:, :2], level[:, None]], axis=1)
        nearest = jnp.concatenate([(position * flat)[None], axes, other_position])
        origin = jnp.concatenate([(position * flat)[None], pillars, other_position])
        moving = jnp.concatenate([jnp.zeros((1 + p, 3), dtype), other_velocity])
        away = position - nearest
        distance = jnp.sqrt(jnp.sum(away * away, axis=-1) + 1e-12)
        normal = away / distance[:, None]
        gap = distance - radius
        gap_ahead = gap + dt * jnp.sum(normal * (velocity - moving), axis=-1)
        hit = jnp.any(gap_ahead < 0.0)
        shown = jnp.where(hit & (gap < _NEAR) & (gap_ahead >= 0.0), _TOUCHING, gap_ahead)
        return origin - normal * (shown - gap)[:, None]

    neighbours = others(n)
    return jax.vmap(seen_by_one)(position, velocity, position[neighbours], velocity[neighbours])

"""Solid things around a drone: the floor, vertical pillars, the other drones; and what
the solver of contacts is shown of them.

A test of present positions would let a drone sink in by the way of one step before
anything stops it. So the solver is shown each thing moved along the present normal of
contact to where its surface will be, seen from the drone, at the end of the step if
nothing intervened. A contact then stops the drone at the surface, in the step in which
it would have passed it. While one thing is hit, whatever else is near is shown as just
touching: it may not be approached faster because of that impact, which keeps a drone
from being squeezed through a gap narrower than itself.

The same contacts are solved by MuJoCo MJX (`place_solids`, `mjx_body`) and, written
out, by `openjax.vehicle.contacts`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from openjax.vehicle.arena import Arena
from openjax.vehicle.shapes import (
    Active,
    Components,
    Gaps,
    Others,
    Pillars,
    Seconds,
    Team,
    Things,
    Vector,
)

DRONE_RADIUS = 0.05  # m, the solid sphere of a drone
PARKED = -100.0  # m, height of a pillar that isn't there


@flax.struct.dataclass
class Obstacles:
    """The things that one drone may touch beside the floor: P pillar slots and K other drones."""

    pillar_position: Pillars
    pillar_active: Active
    other_position: Others  # m
    other_velocity: Others  # m/s


class Contact(NamedTuple):
    """A contact in MuJoCo's direct form: acceleration along the normal >= -stiffness *
    gap - damping * speed, `gap` being the one at the end of the step.
    """

    stiffness: Gaps  # in 1/dt^2
    damping: Gaps  # in 1/dt
    impedance: Gaps  # the share of that which is enforced


@flax.struct.dataclass
class Thing:
    """One solid thing beside a drone, or arrays over many; what doesn't vary is a
    float.
    """

    place: Components  # m, where its shape stands
    level: Gaps  # m, height of its point nearest to the drone
    velocity: Components  # m/s
    reach: Gaps  # m, between it and the drone's centre when their surfaces touch
    contact: Contact


@flax.struct.dataclass
class Encounters:
    """One drone beside its solid things: floor, P pillars, K other drones, in this
    order (M = 1 + P + K).

    Vectors are their three components, each an array over the things: so a processor
    works on eight of them at once.
    """

    things: Thing  # arrays over the things
    normal: Components  # unit vector from the nearest point of each thing to the drone
    gap: Gaps  # m, between the surfaces now
    shown: Gaps  # m, the gap that the solver of contacts is shown; < 0: it acts


# Fixed things: stiffness and damping together cancel the approach in one step and close
# 0.4 of the gap, below the half at which a resting drone would chatter.
_FIXED = Contact(0.4, 0.6, 0.99)
# Other drones: each of the pair takes half of the approach, an inelastic impact of
# equal masses that keeps their momentum; a low impedance, since the other gives way
# too.
_DRONE = Contact(0.5, 0.0, 0.5)
_STILL = (0.0, 0.0, 0.0)  # m/s

# m, gap within which a thing counts as near: the way of a fast drone in one step
_NEAR = 0.04
_TOUCHING = -1e-6  # m, gap at which a contact acts but doesn't push


def solids_xml(arena: Arena, n_pillars: int, n_others: int, dt: float) -> tuple[str, str]:
    """MJCF of the shapes (floor, pillars, other drones) and of their contact pairs with
    the geom "drone".
    """
    shapes = ['<geom name="floor" type="plane" size="0 0 1"/>']
    pillar = f'type="capsule" size="{arena.pillar_radius} {arena.height / 2}"'
    shapes += [f'<geom name="pillar_{k}" {pillar}/>' for k in range(n_pillars)]
    sphere = f'type="sphere" size="{DRONE_RADIUS}"'
    shapes += [f'<geom name="other_{k}" {sphere}/>' for k in range(n_others)]

    pairs = [_pair("floor", _FIXED, dt)]
    pairs += [_pair(f"pillar_{k}", _FIXED, dt) for k in range(n_pillars)]
    pairs += [_pair(f"other_{k}", _DRONE, dt) for k in range(n_others)]
    return "".join(shapes), "".join(pairs)


def _pair(name, contact, dt):
    """MJCF of the contact with one shape. Negative numbers are MuJoCo's sign for its
    direct form.
    """
    return (
        f'<pair geom1="drone" geom2="{name}" condim="1" '
        f'solref="{-contact.stiffness / dt**2} {-contact.damping / dt}" '
        f'solimp="{contact.impedance} {contact.impedance} 0.001"/>'
    )


def others(n: int) -> np.ndarray:
    """(n, n - 1) indices of the other drones, for each of n."""
    return np.array([[j for j in range(n) if j != i] for i in range(n)], int).reshape(n, n - 1)


def surroundings(
    position: Team, velocity: Team, pillar_position: Pillars, pillar_active: Active
) -> Obstacles:
    """The things that each of N drones may touch, leading axis N.

    position and velocity (N, 3) of the drones, pillar_position (P, 2) m, pillar_active
    (P,).
    """
    n = position.shape[0]

    def each(array):
        return jnp.broadcast_to(array, (n, *array.shape))

    neighbours = others(n)
    return Obstacles(
        pillar_position=each(pillar_position.astype(position.dtype)),
        pillar_active=each(pillar_active),
        other_position=position[neighbours],
        other_velocity=velocity[neighbours],
    )


def floor(position: Components) -> Thing:
    """The floor to drones at `position`: it stands below each of them."""
    place = (position[0], position[1], jnp.zeros_like(position[2]))
    return Thing(place, place[2], _STILL, DRONE_RADIUS, _FIXED)


def pillar(arena: Arena, position: Components, place: Sequence[jax.Array], active) -> Thing:
    """A pillar at `place` (x, y) m to drones at `position`; where it isn't `active`, it
    stands far below.
    """
    half = arena.height / 2
    height = jnp.where(active, half, PARKED).astype(position[2].dtype)
    level = jnp.clip(position[2] - height, -half, half) + height
    return Thing((*place, height), level, _STILL, arena.pillar_radius + DRONE_RADIUS, _FIXED)


def other_drone(position: Components, velocity: Components) -> Thing:
    """Another drone."""
    return Thing(position, position[2], velocity, 2 * DRONE_RADIUS, _DRONE)


def _things(arena, position, around) -> Thing:
    """All things around one drone at `position` (3,), in the order of `solids_xml`."""
    place = tuple(position)
    kinds = (
        floor(tuple(part[None] for part in place)),
        pillar(arena, place, tuple(around.pillar_position.T), around.pillar_active),
        other_drone(tuple(around.other_position.T), tuple(around.other_velocity.T)),
    )
    sizes = [kind.level.shape[0] for kind in kinds]

    def join(*parts):
        # what doesn't vary is a float, and floor and pillars come before the drones
        alike = [isinstance(part, float) for part in parts].count(True)
        constant = jnp.asarray(np.repeat(parts[:alike], sizes[:alike]), position.dtype)
        arrays = parts[alike:]
        if not arrays:
            return constant
        return jnp.concatenate([constant, *arrays] if alike else arrays)

    return jax.tree.map(join, *kinds)


def encounters(
    arena: Arena, position: Vector, velocity: Vector, around: Obstacles, dt: Seconds
) -> Encounters:
    """One drone at `position` (3,) m with `velocity` (3,) m/s beside its solid things,
    for a step of dt seconds.
    """
    things = _things(arena, position, around)
    normal, gap, gap_ahead = approach(position, velocity, things, dt)
    solver_gap = shown_gap(gap, gap_ahead, jnp.any(gap_ahead < 0.0))
    return Encounters(things, normal, gap, solver_gap)


def approach(position, velocity, thing: Thing, dt: Seconds):
    """The normal of contact (x, y, z), the gap now, and at the end of a step of dt
    seconds if nothing intervened (m), between a drone at `position` with `velocity`,
    three components each, and a thing.
    """
    nearest = (*thing.place[:2], thing.level)
    away = tuple(component - other for component, other in zip(position, nearest, strict=True))
    # the root keeps a slope where a drone is in the middle of a thing
    distance = jnp.sqrt(sum(part * part for part in away) + 1e-12)
    normal = tuple(part / distance for part in away)
    gap = distance - thing.reach
    moving = zip(normal, velocity, thing.velocity, strict=True)
    speed = sum(n * (component - other) for n, component, other in moving)
    return normal, gap, gap + dt * speed


def shown_gap(gap, gap_ahead, hit):
    """The gap (m) that the solver of contacts is shown, by those now and at the step's
    end, where something or nothing is `hit`.
    """
    return jnp.where(hit & (gap < _NEAR) & (gap_ahead >= 0.0), _TOUCHING, gap_ahead)


def place_solids(gaps: Encounters) -> Things:
    """The places at which one drone's shapes are shown to it, (M, 3) m, in the order of
    `solids_xml`.
    """
    shift = gaps.shown - gaps.gap
    places = zip(gaps.things.place, gaps.normal, strict=True)
    return jnp.stack([place - n * shift for place, n in places], axis=-1)

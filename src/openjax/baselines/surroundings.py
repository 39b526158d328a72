"""A pursuer's knowledge of its surroundings, read out of its observation in plain terms."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from openjax.errors import UserError
from openjax.pursuit import Observation, Pursuit
from openjax.pursuit.settings import HIDDEN
from openjax.vehicle import hover_share, vectors
from openjax.vehicle.solids import others

QUATERNION = slice(3, 7)
VELOCITY = slice(7, 10)
"""Where they stand in a pursuer's own part of the observation
(`openjax.pursuit.observation`).
"""


@dataclasses.dataclass(frozen=True)
class Craft:
    """A pursuer's knowledge before it starts: its arena and its vehicle."""

    arena_radius: float = 0.9
    """m"""
    arena_height: float = 1.2
    """m"""
    speed: float = 0.98
    """Speed that the methods command (m/s): short of the largest by the velocity
    controller's overshoot.
    """
    hover_thrust: float = 0.625
    """Collective thrust that carries the vehicle, as a share of the largest."""
    history_seconds: float = 0.09
    """Time between the first and the last frame of the observed history (s)."""
    response: float = 0.15
    """Time that the velocity controller takes to fly what it is told (s). A method is
    asked what it would do where all will be by then: a point mass, which it takes
    itself for, would turn at once.
    """

    @classmethod
    def of(cls, environment: Pursuit) -> "Craft":
        """The craft of an environment's pursuers; UserError where they don't observe in
        the world's axes.
        """
        settings = environment.settings
        if settings.observe_in != "world":
            raise UserError(
                f"environment.observe_in {settings.observe_in}: methods that fly velocities need "
                "world"
            )
        # an environment may be made inside a compiled program
        with jax.ensure_compile_time_eval():
            hover = round(float(hover_share(environment.vehicle)), 6)
        return cls(
            arena_radius=settings.arena_radius,
            arena_height=settings.arena_height,
            speed=0.98 * settings.max_speed,
            hover_thrust=hover,
            history_seconds=(settings.history_length - 1)
            * settings.history_spacing
            * settings.time_step,
        )


@struct.dataclass
class Surroundings:
    """N pursuers' surroundings after their response time, all flying straight on;
    leading axes as in the observation. World frame, m and m/s.
    """

    position: jax.Array  # (..., N, 3)
    velocity: jax.Array  # (..., N, 3)
    target: jax.Array
    """(..., N, 3) the evader; while it is hidden where it was last seen, and the middle
    before.
    """
    target_velocity: jax.Array  # (..., N, 3) zero while it is hidden
    from_others: jax.Array  # (..., N, N - 1, 3) position relative to each other pursuer
    # (..., N, N - 1, 3) velocity relative to each other pursuer
    from_others_velocity: jax.Array
    team_velocity: jax.Array  # (..., N, 3) mean velocity of all pursuers
    obstacle_normal: jax.Array
    """(..., N, k + 1, 2) away from each pillar in sight and from the arena's wall, of
    unit length.
    """
    obstacle_distance: jax.Array
    """(..., N, k + 1) to their surface; infinite where there is no pillar."""
    floor_distance: jax.Array  # (..., N)
    ceiling_distance: jax.Array  # (..., N)


def surroundings(craft: Craft, observation: Observation) -> Surroundings:
    """Read an observation of (..., N) pursuers.

    The others' velocities are those of the observed history, mean over its length (0.09
    s by default): a pursuer measures no velocity but its own.
    """
    own_position = observation.position
    velocity = observation.self_state[..., VELOCITY]
    number = own_position.shape[-2]
    newest = observation.frames[..., -1, :]
    # what is hidden is shown at HIDDEN exactly, far below any place; .9 allows for
    # rounding
    is_seen = newest[..., 1:2] > 0.9 * HIDDEN
    per_pursuer = (*own_position.shape[:-2], number, 3)

    def for_all(vector):
        return jnp.broadcast_to(vector[..., None, :], per_pursuer)

    # a frame is time (1), evader's position and velocity (6) and the pursuers'
    # positions
    displacement = newest[..., 7:] - observation.frames[..., 0, 7:]
    velocities = displacement.reshape(per_pursuer) / max(craft.history_seconds, 1e-6)
    apart_velocity = velocities[..., :, None, :] - velocities[..., others(number), :]
    target_velocity = for_all(jnp.where(is_seen, newest[..., 4:7], 0.0))

    normal, distance = _obstacles(craft, observation)
    position = own_position + craft.response * velocity
    return Surroundings(
        position=position,
        velocity=velocity,
        target=for_all(observation.last_seen) + craft.response * target_velocity,
        target_velocity=target_velocity,
        from_others=observation.others[..., :3] + craft.response * apart_velocity,
        from_others_velocity=apart_velocity,
        team_velocity=for_all(jnp.mean(velocities, axis=-2)),
        obstacle_normal=normal,
        obstacle_distance=distance,
        floor_distance=position[..., 2],
        ceiling_distance=craft.arena_height - position[..., 2],
    )


def _obstacles(craft, observation):
    """`obstacle_normal` and `obstacle_distance`."""
    position = observation.position
    velocity = observation.self_state[..., VELOCITY]
    pillar = observation.pillars
    across = vectors.length(pillar[..., :2])
    to_pillar = jnp.where(observation.pillar_seen, across - pillar[..., 4], jnp.inf)
    radius = vectors.length(position[..., :2], keepdims=True)
    normal = jnp.concatenate(
        [pillar[..., :2] / across[..., None], (-position[..., :2] / radius)[..., None, :]], axis=-2
    )
    distance = jnp.concatenate([to_pillar, craft.arena_radius - radius], axis=-1)
    # along today's normal: straight on, a drone might come out behind a pillar
    receding = jnp.sum(normal * velocity[..., None, :2], axis=-1)
    return normal, distance + craft.response * receding


def length(vector: jax.Array) -> jax.Array:
    """(..., 1) Euclidean length of (..., d), with a gradient at zero."""
    return vectors.length(vector, keepdims=True)


def level(vector: jax.Array) -> jax.Array:
    """(..., 2) in the plane as (..., 3)."""
    return jnp.concatenate([vector, jnp.zeros_like(vector[..., :1])], axis=-1)


def upward(height: jax.Array) -> jax.Array:
    """(...,) along z as (..., 3)."""
    return jnp.stack([jnp.zeros_like(height), jnp.zeros_like(height), height], axis=-1)

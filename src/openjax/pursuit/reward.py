"""The reward (SPEC section 5)."""

import jax
import jax.numpy as jnp

from openjax.pursuit.collisions import Breaches
from openjax.pursuit.settings import PursuitSettings

OVER_SPEED = 1.01
"""Share of the maximal speed above which a step counts as over speed."""


def captures(
    settings: PursuitSettings, position: jax.Array, evader: jax.Array, in_sight: jax.Array
) -> jax.Array:
    """(N,) whether each pursuer has the evader within the capture radius, with a clear line of sight."""
    return in_sight & (jnp.sum((position - evader) ** 2, axis=-1) < settings.capture_radius**2)


def over_speed(settings: PursuitSettings, velocity: jax.Array) -> jax.Array:
    """(N,) whether each pursuer of (N, 3) velocities is faster than 1.01 times the maximal speed."""
    return jnp.sum(velocity**2, axis=-1) > (OVER_SPEED * settings.max_speed) ** 2


def reward(
    settings: PursuitSettings,
    captured: jax.Array,
    distance: jax.Array,
    breach: Breaches,
    too_fast: jax.Array,
    crash: jax.Array,
    first_crash: jax.Array,
    action: jax.Array,
    previous_action: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """(N,) reward of each pursuer, and (N,) the penalties that it holds (at most 0).

    `captured` (N,) bool rewards all; `distance` (N,) to the evader (m), `breach`, `too_fast`, `crash` and `first_crash`
    (N,) bool and the change of the squashed command `action` (N, 4) count for each pursuer.
    """
    weights = settings.reward
    penalty = -weights.collision * breach.total - weights.over_speed * too_fast
    penalty = penalty - weights.crash * crash - weights.first_crash * first_crash
    change = jnp.sqrt(jnp.sum((action - previous_action) ** 2, axis=-1) + 1e-12)
    task = weights.capture * jnp.any(captured) - weights.distance * distance
    return task + weights.smoothness * jnp.exp(-change) + penalty, penalty

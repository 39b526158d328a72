"""The reward (the paper's section IV-A, and what was added to it)."""

import jax
import jax.numpy as jnp

from openjax.pursuit.collisions import breaches, crashed
from openjax.pursuit.info import StepInfo
from openjax.pursuit.observation import rotation_axes
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.state import PursuitState

OVER_SPEED = 1.01
"""Share of the maximal speed above which a step counts as over speed."""


def captures(
    settings: PursuitSettings, position: jax.Array, evader: jax.Array, in_sight: jax.Array
) -> jax.Array:
    """(N,) whether each pursuer has the evader within the capture radius, with a clear line of
    sight.
    """
    return in_sight & (jnp.sum((position - evader) ** 2, axis=-1) < settings.capture_radius**2)


def over_speed(settings: PursuitSettings, velocity: jax.Array) -> jax.Array:
    """(N,) whether each pursuer of (N, 3) velocities is faster than 1.01 times the maximal
    speed.
    """
    return jnp.sum(velocity**2, axis=-1) > (OVER_SPEED * settings.max_speed) ** 2


def reward(
    settings: PursuitSettings, before: PursuitState, state: PursuitState, info: StepInfo
) -> tuple[jax.Array, jax.Array]:
    """(N,) reward of each pursuer for a step from `before` to `state`, and (N,) the penalties in it
    (at most 0).

    A capture by any rewards all; distance to the evader, breaches, speed, crashes and the change of
    the squashed command count for each.
    """
    weights = settings.reward
    breach, crash = _counted(settings, state, info)
    first_crash = info.crashed & ~before.statistics.crashed
    penalty = -weights.collision * breach.total - weights.over_speed * info.over_speed
    penalty = penalty - weights.crash * crash - weights.first_crash * first_crash
    distance = jnp.sqrt(
        jnp.sum((state.drones.position - state.evader_position) ** 2, axis=-1) + 1e-12
    )
    change = jnp.sqrt(
        jnp.sum((state.previous_action - before.previous_action) ** 2, axis=-1) + 1e-12
    )
    captured = jnp.any(info.captured)
    task = weights.capture * captured - weights.distance * distance
    task = task + weights.first_capture * (captured & ~before.statistics.captured)
    return task + weights.smoothness * jnp.exp(-change) + penalty, penalty


def _counted(settings, state, info):
    """The breaches (N,) and crashes (N,) that the reward counts: those of the metrics, early by
    margin and lookahead.
    """
    weights = settings.reward
    drones = state.drones
    breach = info.breaches
    crash = info.crashed
    pillars = (state.task.pillar_position, state.task.pillar_active)
    body_z_up = rotation_axes(drones.quaternion)[1][:, 2]
    if weights.margin != 0.0:
        breach = breaches(settings, drones.position, *pillars, weights.margin)
        crash = crashed(settings, drones.position, body_z_up, *pillars, weights.margin)
    if weights.lookahead != 0.0:
        ahead = drones.position + weights.lookahead * drones.velocity
        breach = jax.tree.map(jnp.maximum, breach, breaches(settings, ahead, *pillars))
        crash = crash | crashed(settings, ahead, body_z_up, *pillars)
    return breach, crash

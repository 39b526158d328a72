"""Counts of an episode: the paper's metrics and ours."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from openjax.pursuit.info import StepInfo
from openjax.pursuit.shapes import Count, Each, Which
from openjax.pursuit.teams import team_mean


@struct.dataclass
class EpisodeStatistics:
    """Running counts of one episode; every leaf ()."""

    steps: jax.Array  # int32, steps counted
    capture_step: jax.Array
    """int32, first step with a capture, counted from 1; the episode's length if none"""
    captured: jax.Array  # bool
    free_steps: jax.Array  # int32, steps since any pursuer last had the evader
    collision_steps: jax.Array  # float32, steps in which any pursuer breached any limit
    pillar_steps: jax.Array  # float32, the same by parts
    drone_steps: jax.Array
    bounds_steps: jax.Array
    over_speed_steps: jax.Array
    crashed: jax.Array  # bool, any pursuer touched something solid or tipped over
    episode_return: jax.Array  # float32, sum of rewards, mean over pursuers

    @property
    def collision_rate(self) -> Float[Array, "*worlds"]:
        """() share of steps in which any pursuer breached any limit."""
        return self.collision_steps / jnp.maximum(self.steps, 1)

    @property
    def over_speed_rate(self) -> Float[Array, "*worlds"]:
        """() share of steps with any pursuer above 1.01 times the maximal speed."""
        return self.over_speed_steps / jnp.maximum(self.steps, 1)


def empty_statistics(episode_length: int) -> EpisodeStatistics:
    """Counts at the start of an episode."""
    zero = jnp.zeros((), jnp.float32)
    return EpisodeStatistics(
        steps=jnp.zeros((), jnp.int32),
        capture_step=jnp.full((), episode_length, jnp.int32),
        captured=jnp.zeros((), bool),
        free_steps=jnp.zeros((), jnp.int32),
        collision_steps=zero,
        pillar_steps=zero,
        drone_steps=zero,
        bounds_steps=zero,
        over_speed_steps=zero,
        crashed=jnp.zeros((), bool),
        episode_return=zero,
    )


def count(
    statistics: EpisodeStatistics,
    step: Count,
    info: StepInfo,
    reward: Each,
    active: Which | None = None,
) -> EpisodeStatistics:
    """Add one step; `step` () is its number, counted from 1, `reward` (N,) is the
    pursuers'.

    `active` (N,): slots in use, None: all; nothing of the others is in `info`.
    """
    is_captured = jnp.any(info.captured)
    first = is_captured & ~statistics.captured
    breach = info.breaches

    def any_of(values):
        return jnp.any(values > 0).astype(jnp.float32)

    return EpisodeStatistics(
        steps=statistics.steps + 1,
        capture_step=jnp.where(first, step, statistics.capture_step),
        captured=statistics.captured | is_captured,
        free_steps=jnp.where(is_captured, 0, statistics.free_steps + 1),
        # steps, not breaches: a rate is the share of steps in which anything is
        # breached
        collision_steps=statistics.collision_steps + any_of(breach.total),
        pillar_steps=statistics.pillar_steps + any_of(breach.pillar),
        drone_steps=statistics.drone_steps + any_of(breach.drone),
        bounds_steps=statistics.bounds_steps + any_of(breach.bounds),
        over_speed_steps=statistics.over_speed_steps + any_of(info.over_speed),
        crashed=statistics.crashed | jnp.any(info.crashed),
        episode_return=statistics.episode_return + team_mean(active, reward),
    )

"""Teams of different sizes in one batch: a world has N slots for pursuers, and some may
be empty.

An empty slot keeps a drone, as shapes are the same in all worlds. It is parked far from
everything and held there, so that it is near nothing; what isn't told by distances is
masked.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, PRNGKeyArray, Shaped

from openjax.pursuit.rows import where_rows
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Scalar, Team, Which
from openjax.vehicle import DroneState

FAR = 1000.0
"""Empty slots are parked at least this far from the arena's axis, and from each other a
hundredth of it (m).
"""
T = TypeVar("T")


def draw_team(settings: PursuitSettings, key: PRNGKeyArray) -> Which | None:
    """(N,) bool, the slots in use, the first ones: a team of one of `team_sizes`, with
    equal odds; None where there are none of these, and all slots are in use. `key` is
    the task's.
    """
    if not settings.team_sizes:
        return None
    sizes = jnp.array(settings.team_sizes, jnp.int32)
    # a draw of its own: without team sizes a key's task stays what it was
    size = jax.random.choice(jax.random.fold_in(key, 4), sizes)
    return jnp.arange(settings.num_pursuers) < size


def draw_fall_out(
    settings: PursuitSettings, key: PRNGKeyArray, active: Which | None
) -> Int32[Array, " drones"] | None:
    """(N,) int32, the last step in which each pursuer of a team is there; None where
    the settings have nobody fall out. `active` (N,): slots in use.
    """
    if not settings.fall_outs:
        return None
    number = settings.num_pursuers
    active = jnp.ones(number, bool) if active is None else active
    whether_key, which_key, when_key = jax.random.split(key, 3)
    # an empty slot's number is below all that are drawn
    member = jnp.argmax(jnp.where(active, jax.random.uniform(which_key, (number,)), -1.0))
    low, high = settings.fall_out_seconds
    seconds = jax.random.uniform(when_key, minval=low, maxval=high)
    last = jnp.round(seconds / settings.time_step).astype(jnp.int32)
    # the last one stays, or nobody were left to learn from
    falls = jax.random.bernoulli(whether_key, settings.fall_outs) & (jnp.sum(active) > 1)
    is_gone = falls & (jnp.arange(number) == member)
    return jnp.where(is_gone, last, settings.episode_length)


def still_there(
    active: Bool[Array, "*worlds drones"] | None,
    gone_after: Int32[Array, "*worlds drones"] | None,
    step: Int32[Array, "*worlds"],
) -> Bool[Array, "*worlds drones"] | None:
    """(..., N) bool, slots in use at a step (...).

    Args:
      active: (..., N) bool, those in use at the start; None: all.
      gone_after: (..., N) int32, the last step of each; None: nobody falls out.
      step: (...) int32.
    """
    if gone_after is None:
        return active
    is_there = step[..., None] <= gone_after
    return is_there if active is None else is_there & active


def park(position: Team, active: Which | None) -> Team:
    """Positions (N, 3) m with those of empty slots far away."""
    if active is None:
        return position
    # not all at one place: parked drones would breach each other's distance
    x = FAR * (1.0 + 0.01 * jnp.arange(position.shape[0]))
    away = jnp.stack([x, jnp.zeros_like(x), jnp.ones_like(x)], axis=-1)
    return jnp.where(active[:, None], position, away)


def held(active: Which | None, drones: DroneState) -> DroneState:
    """The drones (leading axis N), those of empty slots at rest where they are parked;
    how they turn doesn't matter.
    """
    if active is None:
        return drones
    velocity = jnp.where(active[:, None], drones.velocity, 0.0)
    return drones.replace(position=park(drones.position, active), velocity=velocity)


def of_team(active: Which | None, value: T) -> T:
    """A tree of (N, ...) arrays whose rows of empty slots are zeros."""
    if active is None:
        return value
    return where_rows(active, value, jax.tree.map(jnp.zeros_like, value))


def team_mean(
    active: Bool[Array, "*steps drones"] | None, value: Shaped[Array, "*steps drones"]
) -> Scalar:
    """() mean of the numbers (..., N) of pursuers, without those of empty slots (...,
    N).
    """
    if active is None:
        return jnp.mean(value)
    return jnp.sum(jnp.where(active, value, 0.0)) / jnp.maximum(jnp.sum(active), 1)


def draw_strategies(
    settings: PursuitSettings, key: PRNGKeyArray, worlds: tuple[int, ...] = ()
) -> Float[Array, "*worlds draws"] | None:
    """(*worlds, D) from 0 to 1, by which a team draws the strategies that it flies one
    after another in an episode (`strategy_of`); None where the settings know only
    one.
    """
    if settings.strategies == 1:
        return None
    draws = -(-settings.episode_length // settings.strategy_steps)
    return jax.random.uniform(key, (*worlds, draws))


def strategy_of(
    settings: PursuitSettings, draw: Float[Array, "*worlds"], is_seen: Bool[Array, "*worlds"]
) -> Int32[Array, "*worlds"]:
    """(...) which strategy a `draw` from 0 to 1 means, by the odds of a team that sees
    the evader or doesn't.
    """
    usual = draws_below(settings.strategy_odds or (1.0,) * settings.strategies)
    while_unseen = (
        draws_below(settings.strategy_odds_unseen) if settings.strategy_odds_unseen else usual
    )
    below = jnp.where(is_seen[..., None], usual, while_unseen)
    return jnp.sum(draw[..., None] >= below, axis=-1, dtype=jnp.int32)


def draws_below(odds):
    """(K - 1,) the draws below which the first, the second ... strategy is meant."""
    share = np.cumsum(odds) / np.sum(odds)
    return share[:-1].astype(np.float32)

"""Past selves of an evader that learns, drawn by Hedge (multiplicative weights).

Of K networks that a game names the first learns; in the places of the others fly past selves of it, from a pool. What one of
these is paid is the share of the time that it stayed free, in the worlds that began since it was drawn. Only those that fly are
paid, so that each payoff, as a difference from the learner's, counts the more the less likely its draw was (Auer et al., 2002):
on average the weights grow as if all had flown.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from openjax.learning.collectives import mean_over_devices
from openjax.learning.settings import EvaderLearningSettings

UNIFORM = 0.2
"""Share of the draws that don't ask for the weights."""


@struct.dataclass
class EvaderPool:
    """P past selves, of which K - 1 fly; the same on all devices."""

    actor: Any  # (P, ...)
    log_std: jax.Array  # (P, 3)
    log_weight: jax.Array  # (P,), the weights' mean is one
    drawn: jax.Array  # (K - 1,) int32, places in the pool
    flown: (
        jax.Array
    )  # (K,) rollouts of worlds that began since the draw, as shares of all worlds', the learner's first ...
    free: jax.Array  # (K,) ... and how much of them the evader was free

    @property
    def odds(self) -> jax.Array:
        """(P,) of a draw."""
        return (1.0 - UNIFORM) * jax.nn.softmax(self.log_weight) + UNIFORM / self.log_weight.size

    @property
    def variety(self) -> jax.Array:
        """() from 1 to P: with as many past selves at equal odds, a draw would be as hard to guess."""
        return jnp.exp(-jnp.sum(self.odds * jnp.log(self.odds)))


def start_pool(actor: Any, log_std: jax.Array, size: int) -> EvaderPool:
    """The networks of all K places, (K, ...), each as often as the others."""
    number = log_std.shape[0]
    actor, log_std = _at((actor, log_std), jnp.arange(size) % number)
    none = jnp.zeros(number, jnp.float32)
    drawn = jnp.arange(1, number, dtype=jnp.int32) % size
    return EvaderPool(actor, log_std, jnp.zeros(size, jnp.float32), drawn, flown=none, free=none)


def with_drawn(pool: EvaderPool, learner: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
    """Actors and log standard deviations of all K places; `learner` those of the first, (1, ...)."""
    past = _at((pool.actor, pool.log_std), pool.drawn)
    return jax.tree.map(lambda own, past: jnp.concatenate([own, past]), learner, past)


def paid(
    pool: EvaderPool, which: jax.Array, flying: jax.Array, begun: jax.Array, axis: str | None
) -> EvaderPool:
    """The pool after a rollout.

    which (E,): the place of each world's evader; flying (T, E): not caught before a step; begun (E,): since the draw.
    """
    worlds = begun[:, None] * jax.nn.one_hot(which, pool.flown.size)
    free = jnp.mean(flying.astype(jnp.float32), axis=0)[:, None] * worlds
    flown, free = mean_over_devices((jnp.mean(worlds, axis=0), jnp.mean(free, axis=0)), axis)
    return pool.replace(flown=pool.flown + flown, free=pool.free + free)


def renewed(
    how: EvaderLearningSettings,
    pool: EvaderPool,
    learner: tuple[Any, jax.Array],
    updates: jax.Array,
    key: jax.Array,
) -> EvaderPool:
    """The pool after `updates` () of the run: where one is due, with a draw, and before it with the learner as it is now."""
    draws, since = jnp.divmod(updates, how.pool_every)
    snapshots, since_draw = jnp.divmod(draws, how.pool_draws)
    new = hedged(pool, how.pool_rate)
    oldest = (since_draw == 0) & (jnp.arange(how.pool) == (snapshots - 1) % how.pool)

    def put(old, own):
        return jnp.where(oldest.reshape(-1, *[1] * (old.ndim - 1)), own, old)

    actor, log_std = jax.tree.map(put, (pool.actor, pool.log_std), learner)
    new = new.replace(actor=actor, log_std=log_std, log_weight=jnp.where(oldest, 0.0, new.log_weight))
    drawn = jax.random.categorical(key, jnp.log(new.odds), shape=pool.drawn.shape)
    new = new.replace(drawn=drawn, flown=jnp.zeros_like(pool.flown), free=jnp.zeros_like(pool.free))
    return jax.tree.map(lambda new, old: jnp.where(since == 0, new, old), new, pool)


def hedged(pool: EvaderPool, rate: float) -> EvaderPool:
    """The pool with the weights that its payoffs lead to."""
    payoff = pool.free / jnp.maximum(pool.flown, 1e-6)
    told = (pool.flown[1:] > 0.0) & (pool.flown[0] > 0.0)
    gain = jnp.where(told, payoff[1:] - payoff[0], 0.0) / (pool.drawn.size * pool.odds[pool.drawn])
    # no scatter: on a GPU its sums have no fixed order
    by_place = jnp.sum(gain[:, None] * jax.nn.one_hot(pool.drawn, pool.log_weight.size), axis=0)
    log_weight = pool.log_weight + rate * by_place
    mean = jax.nn.logsumexp(log_weight) - jnp.log(log_weight.size)
    return pool.replace(log_weight=log_weight - mean)


def _at(tree, places):
    return jax.tree.map(lambda leaf: leaf[places], tree)

"""Past selves drawn by Hedge: who is paid what, who is drawn, who is replaced."""

import jax
import jax.numpy as jnp
import numpy as np

from openjax.learning.evader_pool import UNIFORM, paid, renewed, start_pool, with_drawn
from openjax.learning.settings import EvaderLearningSettings

PLACES, SIZE, WORLDS, STEPS = 3, 4, 300, 5
HOW = EvaderLearningSettings(pool=SIZE, pool_every=3, pool_draws=2, pool_rate=0.5)


def actor(*numbers):
    return {"number": jnp.array(numbers, jnp.float32)[:, None]}


@jax.jit
def rollout(pool, worlds, learner, updates, key):
    pool = paid(pool, *worlds, None)
    return pool, renewed(HOW, pool, learner, updates, key)


def test_weights_draws_and_replacements_are_those_worked_out_one_by_one():
    rng = np.random.default_rng(0)
    pool = start_pool(actor(0, 1, 2), jnp.zeros((PLACES, 3)), SIZE)
    log_weight, past = np.zeros(SIZE), np.array([0.0, 1.0, 2.0, 0.0])
    for updates in range(1, 31):
        which, begun = rng.integers(-1, PLACES, WORLDS, np.int32), rng.random(WORLDS) < 0.7
        flying = np.arange(STEPS)[:, None] < STEPS * rng.random(WORLDS)
        learner = actor(10 + updates), jnp.zeros((1, 3))
        before, after = rollout(pool, (which, flying, begun), learner, updates, jax.random.key(updates))
        if updates % HOW.pool_every:
            np.testing.assert_array_equal(after.drawn, pool.drawn)
        else:
            odds = (1 - UNIFORM) * np.exp(log_weight) / np.exp(log_weight).sum() + UNIFORM / SIZE
            payoff = np.asarray(before.free / before.flown)
            for place, drawn in enumerate(np.asarray(pool.drawn), 1):
                log_weight[drawn] += 0.5 * (payoff[place] - payoff[0]) / (2 * odds[drawn])
            log_weight -= np.log(np.exp(log_weight).mean())
        if updates % (HOW.pool_every * HOW.pool_draws) == 0:
            oldest = (updates // 6 - 1) % SIZE
            log_weight[oldest], past[oldest] = 0.0, 10 + updates
        own = np.stack([(which == place) & begun for place in range(PLACES)])
        grown = (own * flying.mean(0)).sum(1) / WORLDS
        np.testing.assert_allclose(before.free - pool.free, grown, atol=1e-5)
        np.testing.assert_allclose(before.flown - pool.flown, own.sum(1) / WORLDS, atol=1e-5)
        np.testing.assert_allclose(after.log_weight, log_weight, atol=1e-5)
        np.testing.assert_array_equal(after.actor["number"][:, 0], past)
        flown = with_drawn(after, learner)[0]["number"][:, 0]
        np.testing.assert_array_equal(flown, [10 + updates, *past[after.drawn]])
        pool = after


def test_who_stays_free_longest_is_drawn_most():
    share = jnp.full(8, 0.3).at[5].set(0.5)
    how = EvaderLearningSettings(pool=8, pool_every=1, pool_draws=1000, pool_rate=0.5)
    start = start_pool(actor(0, 1, 2), jnp.zeros((PLACES, 3)), 8)

    def one(pool, updates):
        free = jnp.concatenate([jnp.array([0.3]), share[pool.drawn]])
        pool = pool.replace(flown=jnp.ones(PLACES), free=free)
        learner = actor(0), jnp.zeros((1, 3))
        return renewed(how, pool, learner, updates, jax.random.key(updates)), None

    pool = jax.jit(lambda pool: jax.lax.scan(one, pool, jnp.arange(1, 101))[0])(start)
    assert pool.odds[5] > 0.7 and start.odds[5] == 1 / 8
    assert pool.variety < 0.5 * start.variety

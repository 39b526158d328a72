"""The stage by the gradient through the simulation: its starts, what it counts, and
that it learns it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from openjax.learning import AnalyticSettings
from openjax.learning.drawn_starts import APART, side_by_side
from openjax.learning.gradient.last_flights import LastFlights
from openjax.learning.gradient.measures import (
    SMOOTH,
    SmoothFlight,
    breach_share,
    crash_depth,
    crash_share,
    free_flight,
)
from openjax.learning.gradient.stage import GradientStage, compile_stage
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings, uniform_task
from openjax.pursuit.collisions import breaches
from openjax.pursuit.task import starts_clear

GAME = PursuitSettings(min_pillars=0, max_pillars=1)


def test_all_stand_side_by_side():
    keys = jax.random.split(jax.random.key(0), 64)
    before = jax.jit(jax.vmap(lambda key: uniform_task(GAME, key)))(keys)
    tasks = jax.jit(jax.vmap(lambda key, task: side_by_side(GAME, key, task)))(keys, before)
    position = np.asarray(tasks.pursuer_position)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 9 * np.eye(3)
    moved = (position != np.asarray(before.pursuer_position)).any((1, 2))
    assert moved.mean() > 0.5
    assert (apart[moved].min(2) < GAME.drone_clearance + APART + 1e-4).all()
    near = dataclasses.replace(
        GAME, drone_clearance=GAME.drone_clearance - 0.01
    )  # outside the arena counts, too
    near = dataclasses.replace(near, arena_radius=9.0, arena_height=9.0)
    clear = jax.jit(jax.vmap(lambda task: starts_clear(near, task)))
    assert np.asarray(clear(tasks))[moved].all()


@pytest.fixture(scope="module")
def stage():
    """A stage of a small network on a family of one effect, and its parameters."""
    game = PursuitSettings(
        physics="rigid", max_pillars=4, vehicles=(("rotor_drag.d_xy", 0.0, 0.01, 0.0, 0.02),)
    )
    policy = Policy.for_environment(
        Pursuit(game), NetworkSettings(features=8, heads=1), PredictorSettings(enabled=False)
    )
    how = AnalyticSettings(updates=6, worlds=4, learning_rate=3e-3, hold=0.0)
    environment = free_flight(Pursuit(game))
    observation, _ = jax.jit(environment.reset)(jax.random.key(0))
    return LastFlights(how, SmoothFlight(environment, policy)), jax.jit(policy.init)(
        jax.random.key(1), observation
    )


@pytest.mark.slow
def test_smooth_breaches_are_those_of_the_game(stage):
    game = stage[0].flight.game
    key = jax.random.split(jax.random.key(2), 3)
    tasks = jax.jit(jax.vmap(lambda key: uniform_task(game, key)))(jax.random.split(key[0], 256))
    _, state = jax.jit(jax.vmap(stage[0].flight.environment.reset_to))(
        jax.random.split(key[1], 256), tasks
    )
    position = jax.random.uniform(key[2], (256, 3, 3), minval=-0.6, maxval=0.6) * jnp.array(
        [2.0, 2.0, 2.2]
    )
    state = state.replace(drones=state.drones.replace(position=position))
    counted = jax.vmap(lambda p, t: breaches(game, p, t.pillar_position, t.pillar_active).total)
    hard = np.asarray(counted(position, tasks))
    smooth = np.asarray(breach_share(game, state))
    assert 0.2 < (hard > 0).mean() < 0.9
    assert (smooth > 0.7 * hard).all()
    assert np.abs(smooth - hard).mean() < 0.1


def test_deep_crashes_are_learnt_from():
    """Where the share of a crash is flat its depth isn't: it falls by one every
    `SMOOTH` metres.
    """
    gap = jnp.array([-0.2, -0.05, 0.0, 0.05, 0.2])
    slope = jax.vmap(jax.grad(crash_depth))(gap)
    np.testing.assert_allclose(slope, -crash_share(gap) / SMOOTH, rtol=1e-5)
    assert slope[0] == pytest.approx(-1.0 / SMOOTH)


@pytest.mark.slow
def test_hard_starts_are_those_that_come_nearest(stage):
    gradient, parameters = stage
    key = jax.random.key(5)

    @jax.jit
    def least(starts):
        met = gradient.flight.fly(parameters.actor, parameters, starts, gradient.steps)[1]
        return met.least.min(-1)

    bounds = jnp.concatenate([gradient.bounds()] * gradient.settings.DRAWS)
    all_of_them = np.sort(least(gradient.starts(key, bounds)))
    hard = np.sort(least(jax.jit(gradient.hard_starts)(parameters.actor, parameters, key)))
    np.testing.assert_allclose(hard, all_of_them[: gradient.settings.worlds], atol=1e-4)


@pytest.mark.slow
def test_gradient_is_that_of_the_loss_and_learning_follows_it(stage):
    gradient, parameters = stage
    starts = gradient.starts(jax.random.key(3), gradient.bounds())

    @jax.jit
    def loss(actor):
        return gradient.loss(actor, parameters, starts, starts)[0]

    value, slope = jax.jit(jax.value_and_grad(loss))(parameters.actor)
    steepness = float(optax.global_norm(slope))
    step = 1e-3
    direction = jax.tree.map(lambda leaf: leaf / steepness, slope)

    def moved(size):
        return loss(
            jax.tree.map(lambda leaf, along: leaf + size * along, parameters.actor, direction)
        )

    assert moved(step) - moved(-step) == pytest.approx(2 * step * steepness, rel=0.1)
    updates = list(
        compile_stage(GradientStage(gradient), parameters)(parameters, jax.random.key(4))
    )
    assert len(updates) == 6
    assert all(np.isfinite(list(parts.values())).all() for _, parts in updates)
    assert loss(updates[-1][0].actor) < value

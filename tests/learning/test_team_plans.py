"""The search over plans of a whole team, against plain loops and what points can do."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.learning.team_plans import ACCELERATION, STEP, TeamPlans, no_plan
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, scenario_task

GAME = PursuitSettings(max_pillars=6)
PLANS = TeamPlans(GAME, plans=7, seconds=0.6)


@pytest.fixture(scope="module")
def wall():
    """A world before a wall of three pillars, and plans of its evader."""
    task = scenario_task(GAME, SCENARIOS["hidden"])
    task = task.replace(evader_position=jnp.array([-0.35, 0.0, 0.6]))
    _, state = jax.jit(Pursuit(GAME).reset_to)(jax.random.key(0), task)
    ways = jax.random.normal(jax.random.key(1), (3, 1, 3))
    return state, jnp.broadcast_to(ways, (3, PLANS.steps, 3))


def test_the_best_plan_is_best_against_the_worst_answer(wall):
    state, velocities = wall
    key = jax.random.key(2)
    paths = PLANS.paths(state.task)
    best, worth = jax.jit(PLANS.best)(state, paths, velocities, no_plan(3), key)
    teams = PLANS.candidates(key, no_plan(3))

    @jax.jit
    def payoff_of(team, velocity):
        end = PLANS.fly(state.task, paths, PLANS.start(state), team, velocity)[0]
        return PLANS.payoff(state.task, paths, end)

    payoff = np.zeros((7, 3))
    for i, j in itertools.product(range(7), range(3)):
        team = jax.tree.map(lambda leaf, i=i: leaf[i], teams)
        payoff[i, j] = payoff_of(team, velocities[j])
    chosen = payoff.max(axis=1).argmin()
    assert float(worth) == pytest.approx(payoff[chosen].max(), abs=1e-4)
    np.testing.assert_allclose(best.place, teams.place[chosen], atol=1e-6)


def test_points_are_no_faster_than_quadrotors(wall):
    state, velocities = wall
    places = np.asarray(
        jax.jit(PLANS.way)(state, PLANS.paths(state.task), no_plan(3), velocities[0])
    )
    velocity = np.diff(places, axis=0) / STEP
    assert np.linalg.norm(velocity, axis=-1).max() <= GAME.max_speed + 1e-4
    change = np.diff(velocity, axis=0) / STEP
    assert np.linalg.norm(change, axis=-1).max() <= ACCELERATION + 1e-2


def test_a_team_catches_who_stays_behind_a_wall(wall):
    state, _ = wall
    longer = dataclasses.replace(PLANS, seconds=1.6)
    stays = jnp.zeros((1, longer.steps, 3))
    _, worth = jax.jit(longer.best)(
        state, longer.paths(state.task), stays, no_plan(3), jax.random.key(3)
    )
    assert float(worth) < longer.steps

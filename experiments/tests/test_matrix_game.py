"""Both sides plan: who chooses last, and what the pursuers' plans are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.evaders.matrix_game import MatrixGame, MatrixGameSettings, choose
from experiments.evaders.points import Team, game_of_points
from openjax.evaluation.judges.duel import Duel
from openjax.pursuit import Task

PAYOFF = jnp.array([[3.0, 1.0], [0.0, 2.0], [0.5, 0.9]])
"""Rows are the evader's plans, who wants much."""


def test_who_chooses_last_knows_the_other_s_plan():
    evader, team = choose(PAYOFF, pursuers_last=True)
    assert (evader, team) == (0, 1) and PAYOFF[evader, team] == 1.0
    evader, team = choose(PAYOFF, pursuers_last=False)
    assert (evader, team) == (1, 1) and PAYOFF[evader, team] == 2.0


@pytest.mark.slow
def test_pursuers_that_plan_catch_a_slower_evader_that_their_policy_lets_go():
    """The policy hovers; an evader of half their speed that plans is caught all the
    same. Where no pillar stands, who sees honestly sees all.
    """
    game = game_of_points(num_pursuers=2, evader_speed=0.5, evaders=("field",), episode_length=200)

    def flight(observation, state, velocity):
        share = velocity / game.settings.max_speed
        return jnp.concatenate([jnp.zeros((2, 1)), share], axis=-1)

    duel = Duel(game, Team(lambda observation: jnp.zeros_like(observation.self_state[..., :3])))
    place = jnp.array([[[0.5, 0.2, 0.6], [0.5, -0.2, 0.6]]])
    task = Task(place, jnp.array([[-0.3, 0.0, 0.6]]), jnp.zeros((1, 1, 2)), jnp.zeros((1, 1), bool))
    start = duel.start(task, jax.random.key(0))

    def flown(last, full_sight):
        settings = MatrixGameSettings(
            last, evader_plans=6, team_plans=6, direct_plans=4, full_sight=full_sight
        )
        fly = jax.jit(MatrixGame(settings, duel, flight).fly)
        return fly({}, start, jax.random.key(1))

    for last in (True, False):
        statistics = flown(last, full_sight=True)
        assert np.asarray(statistics.captured).all(), last
        honest = flown(last, full_sight=False)
        np.testing.assert_array_equal(statistics.capture_step, honest.capture_step)

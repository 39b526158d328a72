"""Which layouts a policy flies."""

import jax.numpy as jnp

import openjax


def test_a_team_that_no_layout_was_made_for_flies_uniform_tasks():
    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    game = dict(num_pursuers=2, physics="rigid", contacts=False, episode_length=5)
    (record,) = openjax.evaluate(still, episodes=1, **game)
    assert record["scenario"] == "uniform"
    assert record == openjax.evaluate(still, "uniform", episodes=1, **game)

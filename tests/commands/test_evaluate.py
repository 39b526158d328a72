"""Which layouts a policy flies."""

import jax.numpy as jnp

import openjax


def test_a_team_that_no_layout_was_made_for_flies_a_drawn_one():
    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    game = dict(num_pursuers=2, physics="rigid", contacts=False, episode_length=5)
    (record,) = openjax.evaluate(still, episodes=1, **game)
    assert record["scenario"] == "drawn"
    assert record == openjax.evaluate(still, "drawn", episodes=1, **game)

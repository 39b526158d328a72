"""The study of drawn starts: its controller flies, and what it counts is what the game counts."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments import drawn_starts
from experiments.prediction_flights import layout_tasks
from openjax.pursuit import Pursuit, PursuitSettings


def test_plans_are_judged_as_the_game_judges():
    settings = PursuitSettings(physics="rigid", max_pillars=6, episode_length=drawn_starts.STEPS)
    environment = Pursuit(settings)
    tasks = layout_tasks(settings, 1)
    keys = jax.random.split(jax.random.key(4), 6)
    state = jax.jit(jax.vmap(environment.reset_to))(keys, tasks)[1]
    held, best = drawn_starts.least(environment, tasks, state.drones, 2)

    def episode(state):
        target = state.drones.position

        def one(state, _):
            action = drawn_starts.hold_action(environment, state.drones, target)
            return environment.step(keys[0], state, action)[1], None

        return jax.lax.scan(one, state, length=drawn_starts.STEPS)[0]

    end = jax.jit(jax.vmap(episode))(state)
    # the controller brings all back to where they started, also those that start tilted by 50 degrees
    assert np.abs(end.drones.position - state.drones.position).max() < 0.05
    np.testing.assert_allclose(held[:, 0], end.statistics.collision_steps, atol=1)
    np.testing.assert_array_equal(held[:, 1], end.statistics.crashed)
    assert held[:, 0].sum() > 0
    worth = jnp.array([1.0, drawn_starts.STEPS])
    assert (best @ worth <= held @ worth).all()

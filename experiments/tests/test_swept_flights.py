"""Radii and speeds that are swept over at once give what a game with that radius and that speed
gives.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper.flights import fly
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings, uniform_task

pytestmark = pytest.mark.slow

SETTINGS = PursuitSettings(
    physics="rigid", episode_length=60, max_pillars=6, history_length=4, history_spacing=3
)
WORLDS = 12


def test_swept_speed_and_radius_are_those_of_a_game_with_them():
    environment = Pursuit(SETTINGS)
    policy = Policy.for_environment(
        environment,
        NetworkSettings(features=8, heads=2),
        PredictorSettings(units=4, horizons=(1, 5)),
    )
    key = jax.random.key(3)
    parameters = jax.jit(lambda key: policy.init(key, environment.reset(key)[0]))(key)
    tasks = jax.vmap(lambda key: uniform_task(SETTINGS, key))(jax.random.split(key, WORLDS))
    radii = (0.3, 0.6)
    speeds = jnp.where(jnp.arange(WORLDS) < 6, 1.3, 2.0)
    flown = fly(environment, policy, radii, parameters, tasks, speeds, jax.random.key(5))
    first = np.asarray(flown.first)
    keys = jax.random.split(jax.random.key(5), WORLDS)
    other = dataclasses.replace(SETTINGS, evader_speed=2.0, capture_radius=0.6)
    own = Pursuit(other)

    def episode(key, task):
        def one(carry, _):
            observation, state = carry
            return own.step(key, state, policy.act(parameters, observation))[:2], None

        return jax.lax.scan(one, own.reset_to(key, task), length=other.episode_length)[0][
            1
        ].statistics

    expected = jax.jit(jax.vmap(episode))(keys, tasks)
    captured = np.asarray(first[6:, 1]) <= other.episode_length
    np.testing.assert_array_equal(captured, expected.captured[6:])
    assert 0 < captured.sum()
    np.testing.assert_array_equal(first[6:, 1][captured], expected.capture_step[6:][captured])
    statistics = flown.evaluation.statistics
    np.testing.assert_allclose(
        statistics.collision_rate[6:], expected.collision_rate[6:], atol=1e-6
    )
    own_radius = np.where(first[:, 0] > other.episode_length, other.episode_length, first[:, 0])
    np.testing.assert_array_equal(statistics.capture_step, own_radius)
    assert (np.asarray(first[:, 1]) <= np.asarray(first[:, 0])).all()

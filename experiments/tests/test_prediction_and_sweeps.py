"""The studies see the game as the game itself does: windows, predictions, errors; radii and speeds swept at once."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import predictors
from experiments.flights import fly as fly_swept
from experiments.prediction_flights import evader_rule, fly, layout_tasks, training_tasks
from openjax.learning import make_evaluate
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings

SETTINGS = PursuitSettings(
    physics="rigid", episode_length=60, max_pillars=6, history_length=4, history_spacing=3
)
HORIZONS = (1, 5, 10, 20, 40)
WORLDS = 12
TIMES = predictors.compared_times(SETTINGS.episode_length, 2)


@pytest.fixture(scope="module")
def game():
    environment = Pursuit(SETTINGS)
    policy = Policy.for_environment(
        environment, NetworkSettings(features=8, heads=2), PredictorSettings(units=4, horizons=HORIZONS)
    )
    key = jax.random.key(3)
    parameters = jax.jit(lambda key: policy.init(key, environment.reset(key)[0]))(key)
    drawn = training_tasks(SETTINGS, jax.random.key(1), WORLDS - len(SCENARIOS), 10)
    tasks = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), drawn, layout_tasks(SETTINGS, 1))
    return environment, policy, parameters, tasks


@pytest.fixture(scope="module")
def evaluated(game):
    environment, policy, parameters, tasks = game
    return jax.jit(make_evaluate(environment, policy, trajectory=True))(parameters, tasks, jax.random.key(2))


@pytest.fixture(scope="module")
def flights(game):
    source, exploration = jnp.zeros(WORLDS, jnp.int32), jnp.zeros(WORLDS)
    return fly(*game, source, exploration, jax.random.key(2))[0]


def test_predictions_from_flights_are_those_of_the_flown_policy(game, evaluated, flights):
    """History, its spacing and start, where the evader was last seen: all as the game hands them to the predictor."""
    variant = predictors.Variant("own", HORIZONS, frames=4, spacing=3, units=4)
    parameters = jax.tree.map(lambda leaf: leaf[None], game[2].predictor)
    mine = predictors.predict(variant, SETTINGS, parameters, flights, 2)[0]
    np.testing.assert_allclose(mine, evaluated[1].predicted[:, TIMES], atol=2e-5)


def test_errors_are_by_group_and_visibility(flights):
    groups = np.arange(WORLDS) % 2
    true = np.stack([np.asarray(flights.evader)[:, TIMES + h] for h in HORIZONS], axis=2)
    kinds = predictors.visibility(flights, TIMES)
    assert kinds[..., :3].sum(axis=-1).min() == kinds[..., :3].sum(axis=-1).max() == 1
    assert all(kinds[..., i].any() for i in (0, 1)), "the flights should hold both: seen and lost"
    off = np.where(kinds[..., 0], 0.1, 0.3)[..., None, None] * np.array([1.0, 0.0, 0.0])
    off = off * (1 + groups)[:, None, None, None]
    found = predictors.errors(jnp.asarray(true + off), HORIZONS, flights, TIMES, groups)
    np.testing.assert_allclose(found[:, :, 0], [[0.1] * 5, [0.2] * 5], rtol=1e-4)
    for group in (0, 1):
        if kinds[groups == group][..., 1].any():
            np.testing.assert_allclose(found[group, :, 1], 0.3 * (1 + group), rtol=1e-4)
    some = predictors.errors(jnp.asarray(true[:, :, :2]), HORIZONS[:2], flights, TIMES, groups)
    assert np.isnan(some[:, 2:]).all() and np.nanmax(some) == 0.0


def test_evaders_own_rule_finds_it_again_once_it_was_seen(flights):
    path = np.asarray(evader_rule(SETTINGS, flights, TIMES, HORIZONS))
    distance = np.linalg.norm(path[:, :, 0] - np.asarray(flights.evader)[:, TIMES + 1], axis=-1)
    known = ~predictors.visibility(flights, TIMES)[..., 2]
    assert np.median(distance[known]) < 1e-5 and distance[known].max() < 5e-3


def test_training_learns(flights):
    budget = predictors.Budget(updates=100, batch=32, seeds=2)
    first = predictors.Budget(updates=1, batch=32, seeds=2)
    variant = predictors.Variant(
        "all", relative=False, memory=True, balanced=True, pillars=True, frames=2, units=8, learning_rate=1e-2
    )
    lost = predictors.lost_steps(flights)
    assert lost.shape[1] == (~flights.seen & (flights.last_index >= 0))[:, : TIMES[-1] + 1].sum() > 0
    loss = [np.asarray(predictors.train(variant, SETTINGS, b, flights, lost)[1]) for b in (first, budget)]
    assert (loss[1] < 0.5 * loss[0]).all()


def test_swept_speed_and_radius_are_those_of_a_game_with_them(game):
    environment, policy, parameters, tasks = game
    radii, speeds = (0.3, 0.6), jnp.where(jnp.arange(WORLDS) < 6, 1.3, 2.0)
    flown = fly_swept(environment, policy, radii, parameters, tasks, speeds, jax.random.key(5))
    first = np.asarray(flown.first)
    keys = jax.random.split(jax.random.key(5), WORLDS)
    other = dataclasses.replace(SETTINGS, evader_speed=2.0, capture_radius=0.6)
    own = Pursuit(other)

    def episode(key, task):
        def one(carry, _):
            observation, state = carry
            return own.step(key, state, policy.act(parameters, observation))[:2], None

        return jax.lax.scan(one, own.reset_to(key, task), length=other.episode_length)[0][1].statistics

    expected = jax.jit(jax.vmap(episode))(keys, tasks)
    captured = np.asarray(first[6:, 1]) <= other.episode_length
    np.testing.assert_array_equal(captured, expected.captured[6:])
    assert 0 < captured.sum()
    np.testing.assert_array_equal(first[6:, 1][captured], expected.capture_step[6:][captured])
    statistics = flown.evaluation.statistics
    np.testing.assert_allclose(statistics.collision_rate[6:], expected.collision_rate[6:], atol=1e-6)
    own_radius = np.where(first[:, 0] > other.episode_length, other.episode_length, first[:, 0])
    np.testing.assert_array_equal(statistics.capture_step, own_radius)
    assert (np.asarray(first[:, 1]) <= np.asarray(first[:, 0])).all()

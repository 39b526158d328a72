"""One policy for teams of any size: its weights know of no number of pursuers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax import Pursuit, PursuitSettings
from openjax.learning.learners.mappo import loss
from openjax.learning.learners.ppo import Samples
from openjax.learning.settings import MappoSettings
from openjax.policy import NetworkSettings, PredictorSettings, make_policy
from tests.policy.parameters import random_parameters

GAME = PursuitSettings(
    physics="rigid",
    observe_in="heading",
    observe_position=True,
    observe_game=True,
    history_pursuers="pooled",
    history_length=3,
)
SIZE = 5
TEAM = 3
TEAMS = dataclasses.replace(GAME, num_pursuers=SIZE, team_sizes=(TEAM,))


@pytest.fixture(scope="module")
def networks():
    """A policy, a function from parameters and an observation to mean and value, random
    parameters, and an observation of `TEAM` pursuers in `SIZE` slots.
    """
    game = Pursuit(TEAMS)
    network = NetworkSettings(features=16, heads=2, shared_encoder=True)
    policy = make_policy(game, network, PredictorSettings(units=8, horizons=(1, 2)))
    observation = jax.jit(game.reset)(jax.random.key(0))[0]

    def both(parameters, observation):
        predicted = policy.predict(parameters, observation)
        mean, _, value = policy.evaluate(
            parameters.actor, parameters.critic, observation, predicted
        )
        return mean, value

    return policy, jax.jit(both), random_parameters(policy, observation), observation


def alone(observation, number=TEAM):
    """The same team without empty slots."""
    each = ("self_state", "pillars", "pillar_seen", "privileged", "position", "heading")
    cut = {name: getattr(observation, name)[:number] for name in each}
    others = observation.others[:number, : number - 1]
    return observation.replace(**cut, others=others, active=None, others_there=None)


def test_empty_slots_change_nothing(networks):
    """Three of five act, and are judged, as three; whatever stands in the empty
    slots.
    """
    _, both, parameters, observation = networks
    expected = both(parameters, alone(observation))
    there = observation.others_there[..., None]
    for filling in (observation.others, 7.0):
        filled = observation.replace(others=jnp.where(there, observation.others, filling))
        for result, wanted in zip(both(parameters, filled), expected, strict=True):
            np.testing.assert_allclose(result[:TEAM], wanted, atol=1e-5)


def test_teammates_that_change_places_change_actions(networks):
    _, both, parameters, observation = networks
    order = np.array([2, 0, 1])
    three = alone(observation)
    each = ("self_state", "pillars", "pillar_seen", "privileged", "position", "heading")
    moved = three.replace(
        **{name: getattr(three, name)[order] for name in each}, others=three.others[order][:, ::-1]
    )
    for result, wanted in zip(both(parameters, moved), both(parameters, three), strict=True):
        assert np.ptp(wanted, axis=0).max() > 1e-3, "the test shows little"
        np.testing.assert_allclose(result, wanted[order], atol=1e-5)


@pytest.mark.parametrize("number", [1, 2, 8])
def test_the_same_weights_act_for_any_number(networks, number):
    _, both, parameters, _ = networks
    game = Pursuit(dataclasses.replace(GAME, num_pursuers=number))
    observation = jax.eval_shape(game.reset, jax.random.key(2))[0]
    mean, value = jax.eval_shape(both, parameters, observation)
    assert mean.shape == (number, 4) and value.shape == (number,)


def test_nothing_is_learnt_from_empty_slots(networks):
    policy, _, parameters, observation = networks

    def gradient(observation, action):
        number = action.shape[0]
        predicted = policy.predict(parameters, observation)
        samples = Samples(
            inputs=(observation.replace(frames=None), predicted, action),
            log_prob=jnp.linspace(-1.0, 0.0, SIZE)[:number],
            advantage=jnp.linspace(-2.0, 5.0, SIZE)[:number],
            target=jnp.linspace(3.0, -1.0, SIZE)[:number],
        )
        networks = (parameters.actor, parameters.critic)
        return jax.grad(
            lambda networks: loss(MappoSettings(), policy, networks, samples, jnp.asarray(0.2))[0]
        )(networks)

    action = 0.1 * jax.random.normal(jax.random.key(0), (SIZE, 4))
    of_three = jax.jit(gradient)(alone(observation), action[:TEAM])
    of_all = jax.jit(gradient)(observation, action)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), of_all, of_three)

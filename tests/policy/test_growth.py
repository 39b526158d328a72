"""A policy that observes more than it was trained with does what it did, until it
learns.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import openjax
from openjax.policy import NetworkSettings, Policy, PolicyParameters, PredictorSettings
from openjax.policy.growth import in_larger_game
from openjax.pursuit import Pursuit, PursuitSettings

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "frames, predicts, pursuers", [(0, True, "pooled"), (2, False, "each"), (0, True, "each")]
)
def test_the_grown_policy_acts_alike(frames, predicts, pursuers):
    old = PursuitSettings(
        physics="rigid", observe_position=True, observe_history=frames, history_pursuers=pursuers
    )
    new = dataclasses.replace(
        old,
        observe_history=3,
        observe_game=True,
        observe_arena=True,
        history_pursuers="both",
    )
    network = NetworkSettings(features=8, heads=2)
    predictor = PredictorSettings(enabled=predicts, units=4)
    worlds = [Pursuit(settings) for settings in (old, new)]
    policies = [Policy.for_environment(world, network, predictor) for world in worlds]

    @jax.jit
    def both(key):
        observations = []
        for world in worlds:
            state = world.reset(key)[1]
            history = state.own_history
            if history is not None:  # the same newest frames in both
                count = jnp.arange(history.shape[0], 0, -1, dtype=jnp.float32)
                state = state.replace(own_history=history + 0.1 * count[:, None, None])
            observations.append(world.observe(state))
        parameters = policies[0].init(key, observations[0])
        actor = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key, x.shape), parameters.actor)
        parameters = parameters.replace(actor=actor)
        if predicts:
            guesses = parameters.predictor
            noise = jax.tree.map(lambda x: 0.3 * jax.random.normal(key, x.shape), guesses)
            parameters = parameters.replace(predictor=jax.tree.map(jnp.add, guesses, noise))
        grown = in_larger_game(parameters, predictor, old, new)
        return policies[0].act(parameters, observations[0]), policies[1].act(grown, observations[1])

    before, after = both(jax.random.key(0))
    np.testing.assert_allclose(before, after, atol=1e-5)
    assert np.abs(before).max() < 1.0


def test_a_policy_of_the_same_history_is_left_alone():
    settings = PursuitSettings()
    parameters = PolicyParameters(actor={}, critic={}, predictor={})
    assert in_larger_game(parameters, PredictorSettings(), settings, settings) is parameters


def test_a_policy_without_networks_is_refused():
    heuristic = openjax.load_policy("apf")
    longer = dataclasses.replace(heuristic.settings.environment, observe_history=12)
    with pytest.raises(openjax.UserError, match="no networks"):
        in_larger_game(
            heuristic.parameters, PredictorSettings(), heuristic.settings.environment, longer
        )

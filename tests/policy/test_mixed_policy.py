"""Teams that draw which of several policies they fly."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import openjax
from openjax.errors import UserError
from openjax.evaluation.judges.planner import without_foresight
from openjax.policy import MixedPolicy, SortedPolicy, mixed_parameters
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.teams import strategy_of
from openjax.store.mixed_policies import Draws, member, mixed_policy
from tests.policy.parameters import random_parameters
from tests.policy.test_policy import POLICY, observation_of

DRAWN = jnp.array([1, 0, 2, 1])
GAME = PursuitSettings(episode_length=100, strategies=3, strategy_seconds=0.25, physics="stops")


@pytest.fixture(scope="module")
def members():
    first = random_parameters(POLICY, observation_of(0))
    return [jax.tree.map(lambda leaf, k=k: (k + 1) * leaf, first) for k in range(3)]


@pytest.fixture(scope="module")
def worlds():
    """300 of them at their start."""
    keys = jax.random.split(jax.random.key(1), 300)
    return keys, *jax.jit(jax.vmap(Pursuit(GAME).reset))(keys)


def test_each_world_flies_the_member_that_it_drew(members):
    mixed = MixedPolicy(POLICY, 3)
    parameters = mixed_parameters(members)
    observation = observation_of(3).replace(strategy=DRAWN)

    def flown(parameters, observation):
        predicted = mixed.predict(parameters, observation)
        mean, log_std = mixed.distribution(parameters.actor, observation, predicted)
        return mixed.act(parameters, observation), mean, predicted, log_std

    def of_member(one):
        predicted = POLICY.predict(one, observation)
        mean, log_std = POLICY.distribution(one.actor, observation, predicted)
        log_std = jnp.broadcast_to(log_std, (len(DRAWN), 1, 4))
        return POLICY.act(one, observation), mean, predicted, log_std

    together = jax.jit(flown)(parameters, observation)
    of_all = jax.jit(lambda: [of_member(one) for one in members])()
    for world, drawn in enumerate(DRAWN.tolist()):
        for values, expected in zip(together, of_all[drawn], strict=True):
            np.testing.assert_allclose(values[world], expected[world], atol=1e-5)
    # a world by itself, as a vehicle flies it
    single = jax.tree.map(lambda leaf: leaf[0], observation)
    action = jax.jit(mixed.act)(parameters, single)
    np.testing.assert_allclose(action, together[0][0], atol=1e-5)


def test_a_team_flies_its_draws_one_after_another_and_starts_as_without_them(worlds):
    game = Pursuit(GAME)
    keys, observation, state = worlds
    assert state.strategies.shape == (300, 4)
    share = np.bincount((3 * np.asarray(state.strategies)).astype(int).ravel())
    np.testing.assert_allclose(share / state.strategies.size, 1 / 3, atol=0.05)
    observed = jax.jit(jax.vmap(lambda state: game.observe(state).strategy))
    for step, draw in ((0, 0), (24, 0), (25, 1), (99, 3), (100, 3)):
        there = state.replace(step=jnp.full_like(state.step, step))
        drawn = (3 * np.asarray(state.strategies[:, draw])).astype(int)
        np.testing.assert_array_equal(observed(there), drawn)
    plain = Pursuit(dataclasses.replace(GAME, strategies=1))
    usual, _ = jax.jit(jax.vmap(plain.reset))(keys)
    assert usual.strategy is None
    np.testing.assert_array_equal(usual.self_state, observation.self_state)


def test_a_team_draws_by_its_odds_and_by_others_while_nobody_sees_the_evader():
    game = dataclasses.replace(
        GAME, strategy_odds=(1.0, 0.0, 3.0), strategy_odds_unseen=(0.0, 2.0, 0.0)
    )
    draws = jnp.linspace(0.0, 0.999, 400)
    for seen, shares in ((True, (0.25, 0.0, 0.75)), (False, (0.0, 1.0, 0.0))):
        drawn = strategy_of(game, draws, jnp.full(400, seen))
        np.testing.assert_allclose(np.bincount(drawn, minlength=3) / 400, shares, atol=0.01)


def test_worlds_sorted_by_what_they_fly_act_as_unsorted(members):
    """Also where copies of a world draw together, which leaves one member with far more
    worlds than it flies in the mean.
    """
    parameters = mixed_parameters(members)
    unsorted = MixedPolicy(POLICY, 3)
    for copies in (1, 16):
        drawn = np.repeat(np.random.default_rng(1).integers(0, 3, 64 // copies), copies)
        observation = observation_of(5)
        observation = jax.tree.map(
            lambda leaf: jnp.resize(leaf, (64, *leaf.shape[1:])), observation
        )
        observation = observation.replace(strategy=jnp.asarray(drawn))
        by_member = SortedPolicy.of(unsorted, GAME, copies)
        actions = [jax.jit(policy.act)(parameters, observation) for policy in (unsorted, by_member)]
        np.testing.assert_allclose(*actions, atol=1e-5)


def test_an_evader_that_plans_knows_who_flies_and_not_who_comes_next(worlds):
    _, observation, state = worlds
    state = state.replace(step=jnp.full_like(state.step, 30))
    _, planned = without_foresight(GAME, (observation, state), jax.random.key(3))
    same = np.mean(np.asarray(planned.strategies == state.strategies), axis=0)
    np.testing.assert_array_equal(same[:2], 1.0)
    np.testing.assert_allclose(same[2:], 0.0, atol=0.01)


def test_a_mixed_policy_gives_back_its_members_and_takes_no_others():
    evaders = openjax.load_policy("evaders")
    first, second = member(evaders, 0), member(evaders, 1)
    again = mixed_policy([first, second], Draws())
    assert again.settings == evaders.settings
    jax.tree.map(np.testing.assert_array_equal, again.parameters, evaders.parameters)
    more = mixed_policy([evaders, first], Draws(odds=(1.0, 0.0, 3.0)))
    assert more.policy.number == 3 and more.settings.environment.strategy_odds == (1.0, 0.0, 3.0)
    with pytest.raises(UserError, match="one number for each of the 2 strategies"):
        mixed_policy([first, second], Draws(odds=(1.0,)))
    with pytest.raises(UserError, match="evaders, member 0 and open differ in network"):
        mixed_policy([first, openjax.load_policy("open")], Draws())
    with pytest.raises(UserError, match="game draws none; make its game"):
        game = Pursuit(first.settings.environment)
        evaders(jax.eval_shape(game.reset, jax.random.key(0))[0])
    with pytest.raises(UserError, match=r"trained with strategies 2, here it's 1"):
        evaders.in_game(Pursuit(first.settings.environment))

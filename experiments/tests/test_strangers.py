"""Teams of strangers, and pursuers after several evaders."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.evaders.mixed_teams import Strangers, bootstrap_mean
from experiments.evaders.several_evaders import CHOICES, SeveralEvaders, several_tasks
from openjax.pursuit import Pursuit, PursuitSettings, uniform_task

GAME = PursuitSettings(
    physics="rigid",
    contacts=False,
    episode_length=12,
    evaders=("greedy", "way_points"),
    capture_radius=0.9,
)


@dataclasses.dataclass(frozen=True)
class ByVelocity:
    """Thrust, and turns by the own velocity, which stands behind evader and
    attitude.
    """

    gain: float

    def act(self, parameters, observation):
        velocity = observation.self_state[..., 7:10]
        thrust = 0.3 * self.gain * jnp.ones_like(velocity[..., :1])
        return jnp.concatenate([thrust, jnp.tanh(self.gain * velocity)], axis=-1)


def flown_alone(game, policy):
    """(key, task) -> statistics of one policy's episode, step by step."""

    def one(world, _):
        observation, state = world
        observation, state, *_ = game.step(None, state, policy.act({}, observation))
        return (observation, state), None

    def fly(key, task):
        start = game.reset_to(key, task)
        return jax.lax.scan(one, start, length=GAME.episode_length)[0][1].statistics

    return jax.jit(fly)


@pytest.mark.slow
def test_each_of_a_team_flies_its_own_policy_by_what_that_observes():
    """The two policies see other axes, and one of them its history."""
    learned_in = dataclasses.replace(
        GAME, observe_in="heading", observe_history=2, evaders=("field",)
    )
    games = (Pursuit(GAME), Pursuit(GAME.observed_as(learned_in)))
    assert games[1].settings.observe_history == 2 and games[1].settings.evaders == GAME.evaders
    policies = (ByVelocity(2.0), ByVelocity(-1.0))
    keys = jax.random.split(jax.random.key(0), 3)
    tasks = jax.vmap(lambda key: uniform_task(GAME, key))(keys)
    members = jnp.array([[0, 0, 0], [1, 1, 1], [0, 1, 1]])
    key = jax.random.key(1)
    returns = jax.jit(Strangers(games, policies).fly)(({}, {}), tasks, members, key).episode_return
    resets = jax.random.split(key, 3)
    for i, (game, policy) in enumerate(zip(games, policies, strict=True)):
        fly = flown_alone(game, policy)
        alone = [fly(resets[j], jax.tree.map(lambda leaf, j=j: leaf[j], tasks)) for j in (i, 2)]
        np.testing.assert_allclose(returns[i], alone[0].episode_return, rtol=1e-5)
        assert abs(float(returns[2] - alone[1].episode_return)) > 1e-3


def test_intervals_know_strata():
    certain = np.stack([np.zeros(50), np.ones(50)])
    assert bootstrap_mean(certain) == (0.5, 0.5)
    coins = np.tile([0.0, 1.0], (4, 200))
    low, high = bootstrap_mean(coins)
    assert abs(high - low - 2 * 1.96 * 0.5 / 1600**0.5) < 0.004


def test_who_goes_for_whom():
    pursuers = jnp.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [1.0, 0, 0]])
    evaders = jnp.array([[0.05, 0.0, 0], [2.0, 0, 0]])
    wanted = {"nearest": [0, 0, 0, 0], "one_by_one": [0, 0, 0, 0], "shared_out": [0, 0, 1, 1]}
    for name, targets in wanted.items():
        assert list(CHOICES[name](pursuers, evaders, jnp.array([True, True]))) == targets, name
        second = CHOICES[name](pursuers, evaders, jnp.array([False, True]))
        assert list(second) == [1, 1, 1, 1], name


@pytest.mark.slow
def test_an_evader_among_several_flies_as_alone():
    game = Pursuit(GAME)
    key = jax.random.key(2)
    tasks = several_tasks(GAME, key, 2).replace(evader=jnp.array([0, 1]))
    starts = np.asarray(tasks.evader_position)
    assert np.linalg.norm(starts[0] - starts[1]) > 0.05
    policy = ByVelocity(1.0)  # whichever evader it goes for
    flown = jax.jit(SeveralEvaders(game, policy, CHOICES["nearest"]).fly)({}, tasks, key)
    fly = flown_alone(game, policy)
    for i in range(2):
        alone = fly(key, jax.tree.map(lambda leaf, i=i: leaf[i], tasks))
        assert flown.caught[i] == alone.captured and flown.steps[i] == alone.capture_step

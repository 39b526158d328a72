"""Other libraries' interfaces: their own API tests, and that the game behind them is
the same.
"""

import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

import openjax
from openjax.errors import UserError
from openjax.interfaces import ENVIRONMENT
from openjax.interfaces.flat import flat_observation, flat_size
from openjax.interfaces.gymnasium import PursuitEnv, PursuitVectorEnv
from openjax.interfaces.jaxmarl import PursuitMultiAgentEnv
from openjax.interfaces.pettingzoo import PursuitParallelEnv
from openjax.interfaces.restarts import make_restart

LENGTH = 5


@pytest.fixture(scope="module")
def game():
    return openjax.make(physics="rigid", episode_length=LENGTH)


def test_flat_observation_is_all_that_a_pursuer_has(game):
    observation, _ = jax.jit(game.reset)(jax.random.key(0))
    flat = flat_observation(observation)
    assert flat.shape == (3, flat_size(game.settings))
    start = game.settings.self_size
    np.testing.assert_array_equal(
        flat[1, start : start + 3], observation.position[1] - observation.position[0]
    )
    np.testing.assert_allclose(
        flat[:, -3:], observation.position - observation.last_seen, atol=1e-7
    )


def holds(box, x):
    assert x.shape == box.shape
    return bool(np.all(x >= box.low) and np.all(x <= box.high))


def test_spaces_hold_what_the_game_gives(game):
    observation, _ = jax.jit(game.reset)(jax.random.key(1))
    assert jax.tree.all(jax.tree.map(holds, game.observation_space, observation))
    assert holds(game.action_space, game.action_space.sample(jax.random.key(2)))
    assert not holds(game.action_space, np.full((3, 4), 1.5, np.float32))


def test_pettingzoo_passes_its_own_api_test(game):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(PursuitParallelEnv(game), num_cycles=3 * LENGTH)
        parallel_seed_test(lambda: PursuitParallelEnv(game), num_cycles=LENGTH)


def test_gymnasium_vector_env_starts_ended_worlds_anew(game):
    worlds = PursuitVectorEnv(4, game)
    assert isinstance(worlds, gymnasium.vector.VectorEnv)
    first, _ = worlds.reset(seed=3)
    again, _ = PursuitVectorEnv(4, game).reset(seed=3)
    np.testing.assert_array_equal(first, again)
    worlds.action_space.seed(0)
    for step in range(1, 2 * LENGTH + 1):
        action = worlds.action_space.sample()
        observation, reward, terminated, truncated, infos = worlds.step(action)
        assert worlds.observation_space.contains(observation)
        assert reward.shape == terminated.shape == truncated.shape == (4,)
        assert terminated.all() == (step % LENGTH == 0) and not truncated.any()
        assert ("final_obs" in infos) == (step % LENGTH == 0)
    assert not np.allclose(observation, infos["final_obs"])
    # the observed time is that of a start, and of an end
    time = game.settings.self_size - 1
    np.testing.assert_allclose(observation[:, time], 0.0)
    np.testing.assert_allclose(infos["final_obs"][:, time], 1.0)


def test_gymnasium_passes_its_recorder(game):
    worlds = gymnasium.wrappers.vector.RecordEpisodeStatistics(PursuitVectorEnv(2, game))
    worlds.reset(seed=0)
    total = np.zeros(2)
    for _ in range(LENGTH):
        *_, infos = step = worlds.step(np.zeros(worlds.action_space.shape, np.float32))
        total += step[1]
    np.testing.assert_allclose(infos["episode"]["r"], total, rtol=1e-5)
    np.testing.assert_array_equal(infos["episode"]["l"], LENGTH)


@pytest.mark.slow
def test_jaxmarl_interface_is_the_game_and_starts_anew(game):
    adapter = PursuitMultiAgentEnv(game)
    key = jax.random.key(4)
    observations, state = adapter.reset(key)
    jitted = jax.jit(game.step)
    expected, expected_state = jax.jit(game.reset)(key)
    np.testing.assert_allclose(observations["pursuer_2"], flat_observation(expected)[2], atol=1e-6)
    actions = {
        agent: adapter.action_space(agent).sample(jax.random.key(5)) for agent in adapter.agents
    }
    for step in range(1, LENGTH + 1):
        observations, state, rewards, dones, _ = adapter.step(key, state, actions)
        action = jnp.stack([actions[agent] for agent in adapter.agents])
        _, expected_state, reward, *_ = jitted(key, expected_state, action)
        np.testing.assert_allclose([rewards[agent] for agent in adapter.agents], reward, rtol=1e-5)
        assert bool(dones["__all__"]) == (step == LENGTH)
    assert int(state.step) == 0  # a new episode
    _, state, *_ = jax.vmap(adapter.step, in_axes=(0, 0, None))(
        jax.random.split(key, 2), jax.vmap(adapter.reset)(jax.random.split(key, 2))[1], actions
    )
    assert state.step.tolist() == [1, 1]


def test_gymnasium_knows_the_game_by_name_and_its_checker_passes():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity")
        env = gymnasium.make(ENVIRONMENT, episode_length=LENGTH, num_pursuers=2)
        check_env(env.unwrapped, skip_render_check=True)
    first, _ = env.reset(seed=7)
    for step in range(1, LENGTH + 1):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert terminated == (step == LENGTH) and not truncated
    assert isinstance(reward, float) and info == {"captured": False, "crashed": False}
    assert not np.allclose(first, observation)
    np.testing.assert_array_equal(env.reset(seed=7)[0], first)
    worlds = gymnasium.make_vec(
        ENVIRONMENT, num_envs=3, vectorization_mode="vector_entry_point", num_pursuers=2
    )
    assert worlds.reset(seed=0)[0].shape == (3, *first.shape)


def test_settings_beside_an_environment_are_refused(game):
    with pytest.raises(UserError, match="num_pursuers"):
        PursuitEnv(game, num_pursuers=2)


@pytest.mark.parametrize("observe_time", [True, False])
def test_jaxmarl_interface_keeps_a_time_limit_and_what_it_hides(observe_time):
    game = openjax.make(episode_length=2, observe_time=observe_time)
    adapter = PursuitMultiAgentEnv(game)
    advance = jax.jit(adapter.step)
    observations, state = jax.jit(adapter.reset)(jax.random.key(0))
    actions = {agent: jnp.zeros(4) for agent in adapter.agents}
    for step in (1, 2):
        before = state
        observations, state, _, dones, infos = advance(jax.random.key(step), state, actions)
        assert infos["truncated"].tolist() == [step == 2 and not observe_time] * 3
    assert bool(dones["__all__"])
    assert ("final_obs" in infos) != observe_time
    # IPPO makes one number for each agent of each leaf
    assert not observe_time or {leaf.shape for leaf in jax.tree.leaves(infos)} == {(3,)}
    if not observe_time:
        last = jax.jit(adapter.step_env)(jax.random.key(2), before, actions)[0]
        for agent in adapter.agents:
            np.testing.assert_allclose(infos["final_obs"][agent], last[agent], atol=1e-6)
            assert not np.allclose(observations[agent], last[agent])


WRONG_CALLS = """
import jax, numpy as np, openjax
from openjax.errors import UserError
from openjax.interfaces.gymnasium import PursuitEnv, PursuitVectorEnv
from openjax.interfaces.jaxmarl import PursuitMultiAgentEnv
from openjax.interfaces.pettingzoo import PursuitParallelEnv

game = openjax.make()
key = jax.random.key(0)
state = jax.eval_shape(game.reset, key)[1]
for wrong in (
    lambda: game.reset(0),
    lambda: jax.eval_shape(game.reset, jax.random.split(key, 2)),
    lambda: jax.eval_shape(game.step, key, state, np.zeros(4, np.float32)),
    lambda: PursuitEnv(game).step(np.zeros(3)),
    lambda: PursuitVectorEnv(4, game).step(np.zeros((3, 12))),
    lambda: PursuitMultiAgentEnv(num_pursuer=2),
    lambda: PursuitParallelEnv(game, num_pursuers=2),
):
    try:
        wrong()
    except UserError as error:
        print(error)
"""


def test_wrong_calls_are_one_line_each():
    """In a process of its own, whose types nobody checks, as a user's."""
    call = [sys.executable, "-c", WRONG_CALLS]
    lines = subprocess.run(call, check=True, capture_output=True, text=True).stdout.splitlines()
    hints = (
        "hand in jax.random.key(0)",
        "jax.vmap(reset)",
        "3 pursuers take (3, 4)",
        "this takes (12,)",
        "this takes (4, 12)",
        "did you mean num_pursuers?",
        "num_pursuers beside an environment",
    )
    assert len(lines) == len(hints)
    for line, hint in zip(lines, hints, strict=True):
        assert hint in line


def test_settings_are_keywords_of_every_interface():
    assert PursuitMultiAgentEnv(num_pursuers=2).num_agents == 2
    assert len(PursuitParallelEnv(num_pursuers=2).possible_agents) == 2


@pytest.mark.parametrize("ending", [0, 2, 100], ids=["none", "few", "many"])
def test_worlds_that_end_start_as_if_each_drew_alone(ending):
    """However many end, the drawn starts are those of their own keys."""
    worlds = 200

    def start(key):
        return {"place": jax.random.normal(key, (3,)), "step": jnp.zeros((), jnp.int32)}

    over = jnp.arange(worlds) % 100 < ending // 2
    states = {"place": jnp.zeros((worlds, 3)), "step": jnp.full(worlds, 7)}
    keys = jax.random.split(jax.random.key(0), worlds)
    found = jax.jit(jax.vmap(make_restart(start)))(over, keys, states)
    expected = jax.vmap(lambda key: jax.random.normal(key, (3,)))(keys) * over[:, None]
    np.testing.assert_allclose(found["place"], expected, rtol=1e-6)
    np.testing.assert_array_equal(found["step"], jnp.where(over, 0, 7))

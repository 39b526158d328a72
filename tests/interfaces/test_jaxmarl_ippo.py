"""JaxMARL's IPPO trains on the game unchanged: a stand-in for it makes the same calls.

Written after JaxMARL's `baselines/IPPO/ippo_ff_mabrax.py` and `wrappers/baselines.py`
(LogWrapper): what they ask of an environment, without their networks.
"""

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "jaxmarl_ippo.py"

TRAINER = """
import jax
import jax.numpy as jnp
import jaxmarl

ENVS, STEPS = 2, 3
env = jaxmarl.make("ant_4x2", homogenisation_method="max")
actors = env.num_agents * ENVS
width = env.observation_space(env.agents[0]).shape[-1]
size = env.action_space(env.agents[0]).shape[0]


def batchify(rows):
    return jnp.stack([rows[agent] for agent in env.agents]).reshape((actors, -1))


def logged(key, state, action):  # as LogWrapper does, which keeps `info`
    env_state, returns = state
    observations, env_state, reward, done, info = env.step(key, env_state, action)
    rewards = jnp.stack([reward[agent] for agent in env.agents])
    info["returned_episode"] = jnp.full((env.num_agents,), done["__all__"])
    return observations, (env_state, (returns + rewards) * (1 - done["__all__"])), reward, done, info


def step(carry, key):
    state, last = carry
    mean = batchify(last) @ jnp.zeros((width, size))
    action = mean + jax.random.normal(key, mean.shape)
    by_agent = action.reshape((env.num_agents, ENVS, -1))
    by_agent = {agent: by_agent[i] for i, agent in enumerate(env.agents)}
    keys = jax.random.split(key, ENVS)
    last, state, reward, done, info = jax.vmap(logged)(keys, state, by_agent)
    info = jax.tree.map(lambda leaf: leaf.reshape((actors)), info)
    return (state, last), (batchify(done).squeeze(), batchify(reward).squeeze(), info)


def train(key):
    last, env_state = jax.vmap(env.reset)(jax.random.split(key, ENVS))
    start = ((env_state, jnp.zeros((ENVS, env.num_agents))), last)
    return jax.lax.scan(step, start, jax.random.split(key, STEPS))


carry, (done, reward, info) = jax.jit(train)(jax.random.PRNGKey(0))
assert done.shape == reward.shape == info["captured"].shape == (STEPS, actors)
assert jnp.isfinite(reward).all() and not done.any()
print("trained", actors)
"""


@pytest.mark.slow
def test_the_example_hands_the_game_to_an_unchanged_trainer(tmp_path, monkeypatch, capsys):
    (tmp_path / "jaxmarl.py").write_text("def make(name, **settings): raise ValueError(name)")
    script = tmp_path / "ippo.py"
    script.write_text(TRAINER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(script)])
    runpy.run_path(str(EXAMPLE))
    assert capsys.readouterr().out == "trained 6\n"
    monkeypatch.delitem(sys.modules, "jaxmarl")

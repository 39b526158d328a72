"""The comparison with other libraries: stand-ins, the written MAPPO baseline, and what the report says of gaps."""

import importlib
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.compare import report, stand_ins
from experiments.compare.jaxmarl_mappo import MappoSettings, make_update


def test_stand_ins_replace_only_what_is_missing(monkeypatch):
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    assert stand_ins.use_stand_ins(["numpy", "no_such_symbolic_package"]) == ["no_such_symbolic_package"]
    missing = importlib.import_module("no_such_symbolic_package.inner")
    # what module-level code of a symbolic model does
    value = 1 - missing.SX.sym("x", 3)[0] @ missing.eye(3) ** 2
    assert missing.if_else(abs(value) <= 0.5, 1, value) is not None
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("another_missing_package")
    for name in [name for name in sys.modules if name.startswith("no_such_symbolic_package")]:
        del sys.modules[name]


class _Guess:
    """Two agents with observations of unequal length, each rewarded for the action that its first entry names."""

    agents = ("a", "b")

    def observation_space(self, agent):
        return SimpleNamespace(shape=(3 if agent == "a" else 2,))

    def action_space(self, agent):
        return SimpleNamespace(n=2)

    def reset(self, key):
        state = jax.random.bernoulli(key, shape=(2,)).astype(jnp.float32)
        return self._observe(state), state

    def step(self, key, state, actions):
        reward = {
            agent: (actions[agent] == state[i]).astype(jnp.float32) for i, agent in enumerate(self.agents)
        }
        observation, state = self.reset(key)
        done = {name: jnp.array(True) for name in (*self.agents, "__all__")}
        return observation, state, reward, done, {}

    def _observe(self, state):
        return {"a": jnp.array([state[0], 0.0, 1.0]), "b": jnp.array([state[1], 1.0])}


def test_mappo_baseline_learns():
    settings = MappoSettings(num_envs=16, num_steps=16, features=16, learning_rate=1e-2)
    update, initial = make_update(_Guess(), settings)
    update = jax.jit(update)
    training = jax.jit(initial)(jax.random.key(0))
    rewards = []
    for _ in range(12):
        training, reward = update(training)
        rewards.append(float(reward))
    assert rewards[0] < 0.7
    assert np.mean(rewards[-2:]) > 0.95


def _row(variant, worlds, seconds, **more):
    speed = None if seconds is None else worlds / seconds
    row = {"group": "drones", "system": "x", "variant": variant, "worlds": worlds, "agents": 1, "steps": 1}
    timing = {"env_steps_per_second": speed, "agent_steps_per_second": speed, "seconds": seconds}
    return row | timing | {"slowest": seconds, "calls": 5, "compile_seconds": 1.0, "memory": None} | more


def test_report_tells_where_it_is_slower_and_what_is_missing():
    rows = [
        _row("body_rate", 100, 0.1),
        _row("rigid", 100, 0.01),
        _row("mjx", 100, 0.2),
        _row("body_rate", 1000, None, failed="RuntimeError: no"),
        _row("rigid", 1000, 0.1),
        _row("mjx", 1000, None, skipped="time was up"),
    ]
    rigid, mjx = report.verdict(rows)
    assert "10.00" in rigid and "reached everywhere" in rigid
    assert "0.50" in mjx and "missed at 100 x 1" in mjx and "Slower than crazyflow at 100 x 1" in mjx
    table = report.drone_table(rows)
    assert "| 10.00 | 0.50 |" in table[2]
    assert "failed: RuntimeError: no" in table[3] and "time was up" in table[3]

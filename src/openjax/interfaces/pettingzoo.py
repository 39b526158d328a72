"""One world as a PettingZoo `ParallelEnv` (`pip install gymnasium pettingzoo`)."""

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from openjax.interfaces.flat import ACTION_SIZE, flat_observation, flat_size, game_of, to_numpy
from openjax.pursuit import Pursuit


class PursuitParallelEnv(ParallelEnv):
    """Agents `pursuer_0` ... act together; each observes (D,) float32
    (`flat_observation`) and acts with (4,) in -1..1.

    Every pursuer gets its own reward. An episode ends for all at once, after
    `settings.episode_length` steps.

    Args:
      environment: the game; None is the nominal one.
      changes: settings of the nominal game, as for `openjax.make`.

    Raises:
      UserError: both are given, or there is no such setting.
    """

    metadata = {  # noqa: RUF012
        "name": "openjax_pursuit_v0",
        "render_modes": [],
        "is_parallelizable": True,
    }

    def __init__(self, environment: Pursuit | None = None, **changes):
        self.environment = game_of(environment, changes)
        settings = self.environment.settings
        self.possible_agents = [f"pursuer_{i}" for i in range(settings.num_pursuers)]
        self.agents: list[str] = []
        self.render_mode = None
        self._observation_space = spaces.Box(-np.inf, np.inf, (flat_size(settings),), np.float32)
        self._action_space = spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
        self._key = jax.random.key(0)
        self._state = None
        self._reset = jax.jit(self.environment.reset)
        self._step = jax.jit(self.environment.step)

    def observation_space(self, agent: str) -> spaces.Box:
        """The space of one agent's observations."""
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Box:
        """The space of one agent's actions."""
        return self._action_space

    def reset(self, seed: int | None = None, options: dict | None = None):
        """Start an episode; `seed` determines it and those that follow. `options` are
        ignored.
        """
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, key = jax.random.split(self._key)
        self.agents = list(self.possible_agents)
        observation, self._state = self._reset(key)
        observations = self._by_agent(to_numpy(flat_observation(observation)))
        return observations, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, np.ndarray]):
        """One control step of all agents."""
        action = jnp.stack(
            [jnp.asarray(actions[agent], jnp.float32) for agent in self.possible_agents]
        )
        # any key will do: the game draws nothing after its reset
        observation, self._state, *results = self._step(jax.random.key(0), self._state, action)
        reward, terminated, truncated, info = to_numpy(results)
        infos = [
            {"captured": bool(captured), "crashed": bool(crashed)}
            for captured, crashed in zip(info.captured, info.crashed, strict=True)
        ]
        agents = len(infos)
        results = (
            to_numpy(flat_observation(observation)),
            reward.tolist(),
            [bool(terminated)] * agents,
            [bool(truncated)] * agents,
            infos,
        )
        if terminated or truncated:
            self.agents = []  # PettingZoo's sign that the episode is over
        return tuple(self._by_agent(values) for values in results)

    def close(self) -> None:
        """Nothing is held."""

    def _by_agent(self, values):
        return dict(zip(self.possible_agents, values, strict=True))

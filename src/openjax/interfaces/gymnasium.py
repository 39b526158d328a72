"""Many worlds as a Gymnasium `VectorEnv` in which one agent flies the whole team (`pip install
gymnasium pettingzoo`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from openjax.interfaces.flat import ACTION_SIZE, flat_observation, flat_size, to_numpy
from openjax.pursuit import Pursuit


class PursuitVectorEnv(VectorEnv):
    """E worlds at once, as one compiled function.

    Observations (E, N * D) float32 are all pursuers' vectors (`flat_observation`), actions (E, N *
    4) in -1..1 theirs, the reward (E,) is their mean. Worlds start anew in the step that ends them
    (`AutoresetMode.SAME_STEP`): the last observation of the episode is in `infos["final_obs"]`.

    Args:
      num_envs: worlds E.
      environment: the game; None is the nominal one.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, num_envs: int, environment: Pursuit | None = None):
        self.environment = environment or Pursuit()
        settings = self.environment.settings
        self.num_envs = num_envs
        self.render_mode = None
        team = settings.num_pursuers
        self.single_observation_space = spaces.Box(
            -np.inf, np.inf, (team * flat_size(settings),), np.float32
        )
        self.single_action_space = spaces.Box(-1.0, 1.0, (team * ACTION_SIZE,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._key = jax.random.key(0)
        self._state = None
        self._reset = jax.jit(jax.vmap(self._pure_reset))
        self._step = jax.jit(jax.vmap(self._pure_step))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start all worlds anew; `seed` determines them and what follows. `options` are ignored."""
        if seed is not None:
            self._key = jax.random.key(seed)
        observation, self._state = self._reset(self._keys())
        return to_numpy(observation), {}

    def step(self, actions):
        """One control step of all worlds."""
        actions = jnp.asarray(actions, jnp.float32)
        observation, self._state, reward, terminated, truncated, info = self._step(
            self._state, actions
        )
        over = np.asarray(terminated | truncated)
        infos = {name: np.array(value) for name, value in info.items()} | {
            f"_{name}": np.ones(self.num_envs, bool) for name in info
        }
        if over.any():
            fresh_observation, fresh = self._reset(self._keys())
            infos["final_obs"] = to_numpy(observation)
            infos["_final_obs"] = over
            observation, self._state = jax.tree.map(
                lambda new, old: jnp.where(over.reshape(-1, *[1] * (new.ndim - 1)), new, old),
                (fresh_observation, fresh),
                (observation, self._state),
            )
        return *to_numpy((observation, reward, terminated, truncated)), infos

    def _keys(self):
        self._key, key = jax.random.split(self._key)
        return jax.random.split(key, self.num_envs)

    def _pure_reset(self, key):
        observation, state = self.environment.reset(key)
        return flat_observation(observation).ravel(), state

    def _pure_step(self, state, action):
        action = action.reshape(self.environment.settings.num_pursuers, ACTION_SIZE)
        # the game draws nothing after its reset: the key is for the interface only
        observation, state, reward, terminated, truncated, info = self.environment.step(
            jax.random.key(0), state, action
        )
        told = {"captured": jnp.any(info.captured), "crashed": jnp.any(info.crashed)}
        return (
            flat_observation(observation).ravel(),
            state,
            jnp.mean(reward),
            terminated,
            truncated,
            told,
        )

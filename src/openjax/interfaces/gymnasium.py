"""One world as a Gymnasium `Env`, many as a `VectorEnv`; one agent flies the whole team
(`pip install gymnasium`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Env, spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from openjax.errors import UserError
from openjax.interfaces.flat import ACTION_SIZE, flat_observation, flat_size, game_of, to_numpy
from openjax.pursuit import Pursuit
from openjax.pursuit.rows import where_rows


class _Team:
    """The team as one agent: flat observation and action, spaces and pure functions of
    one world.
    """

    def __init__(self, environment: Pursuit | None, changes: dict):
        self.environment = game_of(environment, changes)
        settings = self.environment.settings
        self._number = settings.num_pursuers
        size = (self._number * flat_size(settings),)
        self.observation_space = spaces.Box(-np.inf, np.inf, size, np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self._number * ACTION_SIZE,), np.float32)

    def reset(self, key):
        observation, state = self.environment.reset(key)
        return flat_observation(observation).ravel(), state

    def step(self, state, action):
        action = action.reshape(self._number, ACTION_SIZE)
        # any key will do: the game draws nothing after its reset
        observation, state, reward, terminated, truncated, info = self.environment.step(
            jax.random.key(0), state, action
        )
        events = {"captured": jnp.any(info.captured), "crashed": jnp.any(info.crashed)}
        observation = flat_observation(observation).ravel()
        return observation, state, jnp.mean(reward), terminated, truncated, events


class PursuitEnv(Env):
    """One world in which one agent flies the whole team:
    `gymnasium.make("openjax/Pursuit-v0")`.

    Observation (N * D,) float32: all pursuers' vectors (`flat_observation`). Action (N
    * 4,) in -1..1: theirs. The reward is their mean. `info` says whether somebody
    captured or crashed.

    Args:
      environment: the game; None is the nominal one.
      changes: settings of the nominal game, as for `openjax.make`.

    Raises:
      UserError: both are given, or there is no such setting.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, environment: Pursuit | None = None, **changes):
        team = _Team(environment, changes)
        self.environment = team.environment
        self.observation_space = team.observation_space
        self.action_space = team.action_space
        self.render_mode = None
        self._state = None
        self._reset = jax.jit(team.reset)
        self._step = jax.jit(team.step)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode; `seed` determines it and those that follow. `options` are
        ignored.
        """
        # Gymnasium's generator draws our key, so that its seed determines all episodes
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        observation, self._state = self._reset(key)
        return np.array(observation), {}

    def step(self, action):
        """One control step. Raises UserError for an action of another shape."""
        _check_shape("step(action)", action, self.action_space)
        action = jnp.asarray(action, jnp.float32)
        observation, self._state, *rest = self._step(self._state, action)
        reward, terminated, truncated, events = jax.device_get(rest)
        info = {name: bool(value) for name, value in events.items()}
        return (np.array(observation), float(reward), bool(terminated), bool(truncated), info)


class PursuitVectorEnv(VectorEnv):
    """E worlds at once, as one compiled function.

    Observations (E, N * D) float32 are all pursuers' vectors (`flat_observation`),
    actions (E, N * 4) in -1..1 theirs, the reward (E,) is their mean. Worlds start anew
    in the step that ends them (`AutoresetMode.SAME_STEP`): the last observation of the
    episode is in `infos["final_obs"]`.

    Args:
      num_envs: worlds E.
      environment: the game; None is the nominal one.
      changes: settings of the nominal game, as for `openjax.make`.

    Raises:
      UserError: both are given, or there is no such setting.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, environment: Pursuit | None = None, **changes):
        team = _Team(environment, changes)
        self.environment = team.environment
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space = team.observation_space
        self.single_action_space = team.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._key = jax.random.key(0)
        self._state = None
        self._reset = jax.jit(jax.vmap(team.reset))
        self._step = jax.jit(jax.vmap(team.step))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start all worlds anew; `seed` determines them and what follows. `options` are
        ignored.
        """
        if seed is not None:
            self._key = jax.random.key(seed)
        observation, self._state = self._reset(self._keys())
        return to_numpy(observation), {}

    def step(self, actions):
        """One control step of all worlds. Raises UserError for actions of another
        shape.
        """
        _check_shape("step(actions)", actions, self.action_space)
        actions = jnp.asarray(actions, jnp.float32)
        observation, self._state, reward, terminated, truncated, info = self._step(
            self._state, actions
        )
        over = np.asarray(terminated | truncated)
        # Gymnasium's manner: beside each entry a mask says of which worlds it is
        infos = {name: np.array(value) for name, value in info.items()}
        infos |= {f"_{name}": np.ones(self.num_envs, bool) for name in info}
        if over.any():
            # all worlds start anew, and those that are over take theirs: one compiled
            # program
            fresh_observation, fresh = self._reset(self._keys())
            infos["final_obs"] = to_numpy(observation)
            infos["_final_obs"] = over
            observation, self._state = where_rows(
                jnp.asarray(over), (fresh_observation, fresh), (observation, self._state)
            )
        return *to_numpy((observation, reward, terminated, truncated)), infos

    def _keys(self):
        self._key, key = jax.random.split(self._key)
        return jax.random.split(key, self.num_envs)


def _check_shape(call, actions, space):
    if np.shape(actions) != space.shape:
        raise UserError(f"{call}: an array {np.shape(actions)}, but this takes {space.shape}")

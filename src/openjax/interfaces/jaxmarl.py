"""The game as JaxMARL expects it: dictionaries by agent, and a `step` that restarts when an episode
ends.

It has the methods of `jaxmarl.environments.MultiAgentEnv` without needing JaxMARL:
everything is pure, so its trainers can map and compile it.
"""

import functools

import jax
import jax.numpy as jnp

from openjax.interfaces.flat import ACTION_SIZE, flat_observation, flat_size, game_of
from openjax.interfaces.restarts import make_restart
from openjax.pursuit import Pursuit, PursuitState
from openjax.pursuit.spaces import Box


class PursuitMultiAgentEnv:
    """Agents `pursuer_0` ...; each observes (D,) float32 (`flat_observation`) and acts
    with (4,) in -1..1.

    Args:
      environment: the game; None is the nominal one.
      changes: settings of the nominal game, as for `openjax.make`.

    Raises:
      UserError: both are given, or there is no such setting.
    """

    def __init__(self, environment: Pursuit | None = None, **changes):
        self.environment = game_of(environment, changes)
        self._restart = make_restart(lambda key: self.environment.reset(key)[1])
        self.num_agents = self.environment.settings.num_pursuers
        self.agents = [f"pursuer_{i}" for i in range(self.num_agents)]
        size = flat_size(self.environment.settings)
        self.observation_spaces = {agent: Box(-jnp.inf, jnp.inf, (size,)) for agent in self.agents}
        self.action_spaces = {agent: Box(-1.0, 1.0, (ACTION_SIZE,)) for agent in self.agents}

    @property
    def name(self) -> str:
        """The environment's name."""
        return "openjax_pursuit"

    def observation_space(self, agent: str) -> Box:
        """The space of one agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """The space of one agent's actions."""
        return self.action_spaces[agent]

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array) -> tuple[dict[str, jax.Array], PursuitState]:
        """Start an episode of a uniformly drawn task."""
        observation, state = self.environment.reset(key)
        return self._by_agent(flat_observation(observation)), state

    @functools.partial(jax.jit, static_argnums=0)
    def step(
        self, key: jax.Array, state: PursuitState, actions: dict[str, jax.Array], reset_state=None
    ):
        """`step_env`, and a new episode (of `reset_state`, where given) in place of one
        that has ended. Starts are drawn for the worlds that need one alone; see
        `openjax.interfaces.restarts`.
        """
        key, reset_key = jax.random.split(key)
        _, state, rewards, dones, infos = self.step_env(key, state, actions)
        over = dones["__all__"]
        if reset_state is None:
            state = self._restart(over, reset_key, state)
        else:
            state = jax.tree.map(lambda new, old: jnp.where(over, new, old), reset_state, state)
        return self.get_obs(state), state, rewards, dones, infos

    def step_env(self, key: jax.Array, state: PursuitState, actions: dict[str, jax.Array]):
        """One control step: observations, state, rewards, dones (with `__all__`),
        infos, all by agent.

        `infos` say of each agent (N,) whether it captured or crashed, and whether the
        end is a time limit that nobody observes (`truncated`). Such an end is no end to
        a value: where the settings don't observe time, `infos["final_obs"]` has this
        step's observations by agent, as `step` returns those of the next start.
        """
        action = jnp.stack([actions[agent] for agent in self.agents])
        observation, state, reward, terminated, truncated, info = self.environment.step(
            key, state, action
        )
        over = terminated | truncated
        dones = {agent: over for agent in self.agents} | {"__all__": over}
        observations = self._by_agent(flat_observation(observation))
        # of each agent, as JaxMARL's wrappers stack what is in `infos`
        is_cut = jnp.broadcast_to(truncated, info.captured.shape)
        # (N,) each
        infos = {"captured": info.captured, "crashed": info.crashed, "truncated": is_cut}
        if not self.environment.settings.observe_time:
            infos["final_obs"] = observations
        return observations, state, self._by_agent(reward), dones, infos

    def get_obs(self, state: PursuitState) -> dict[str, jax.Array]:
        """Observations of a state."""
        return self._by_agent(flat_observation(self.environment.observe(state)))

    def get_avail_actions(self, state: PursuitState) -> dict[str, jax.Array]:
        """All actions are possible."""
        return {agent: jnp.ones(ACTION_SIZE) for agent in self.agents}

    def _by_agent(self, rows):
        return {agent: rows[i] for i, agent in enumerate(self.agents)}

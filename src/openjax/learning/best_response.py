"""A best response to fixed pursuers: evaders learn against a policy's mean
(`openjax.learning.evader_learning`).

Seeds learn side by side in one compiled step, each with worlds of its own.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from openjax.learning.best_response_settings import BestResponseSettings
from openjax.learning.evader_learning import EvaderLearning, LearningEvaders
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import (
    EpisodeStatistics,
    Observation,
    Pursuit,
    PursuitState,
    Task,
    turn_task,
    uniform_task,
)
from openjax.pursuit.evaders import draw_evader


@struct.dataclass
class ResponseCarry:
    """Everything that a run is; worlds of all seeds one after the other."""

    evaders: LearningEvaders  # one for each of S seeds
    observation: Observation  # (S * E, ...)
    state: PursuitState  # (S * E, ...)
    key: jax.Array
    update: jax.Array  # () int32


@dataclass(frozen=True, eq=False)
class BestResponse:
    """The evaders' learning against a policy, as pure functions of a `ResponseCarry`."""

    how: BestResponseSettings
    environment: Pursuit
    """Its settings' evaders are ("learned",) as often as there are seeds."""
    policy: Policy
    layouts: Task
    """(L, ...)"""

    @functools.cached_property
    def learning(self) -> EvaderLearning:
        """Of all seeds."""
        return EvaderLearning(self.how, self.environment, self.how.total_updates)

    def start(self, key: jax.Array) -> ResponseCarry:
        """Evaders that do as greedy ones, and worlds at their starts."""
        key, evader_key, world_key = jax.random.split(key, 3)
        observation, state = self._fresh(world_key)
        return ResponseCarry(
            evaders=self.learning.start(evader_key),
            observation=observation,
            state=state,
            key=key,
            update=jnp.zeros((), jnp.int32),
        )

    def _fresh(self, key):
        """Observations and states of all worlds at the start of an episode."""

        def task(key, seed):
            uniform_key, turn_key, choice_key, layout_key = jax.random.split(key, 4)
            uniform = turn_task(turn_key, uniform_task(self.environment.settings, uniform_key))
            which = jax.random.randint(layout_key, (), 0, self.layouts.evader_position.shape[0])
            on_layout = jax.random.uniform(choice_key) < self.how.layouts
            drawn = jax.tree.map(
                lambda a, b: jnp.where(on_layout, a[which], b), self.layouts, uniform
            )
            return drawn.replace(evader=seed)

        def begin(key, seed):
            task_key, reset_key = jax.random.split(key)
            return self.environment.reset_to(reset_key, task(task_key, seed))

        seeds = jnp.repeat(jnp.arange(self.how.seeds), self.how.num_envs)
        return jax.vmap(begin)(jax.random.split(key, seeds.size), seeds)

    def _collect(self, parameters, carry, noise):
        """Samples, and observation and state after them; noise (T, S * E, 3)."""
        key = jax.random.key(0)
        step = jax.vmap(self.environment.step, in_axes=(None, 0, 0, 0))

        def one(world, noise):
            observation, state = world
            action = self.policy.act(parameters, observation)
            wish, samples = self.learning.act(carry.evaders, state, noise)
            observation, state, *_ = step(key, state, action, wish)
            return (observation, state), samples

        return jax.lax.scan(one, (carry.observation, carry.state), noise)

    def step(
        self, parameters: PolicyParameters, carry: ResponseCarry
    ) -> tuple[ResponseCarry, dict[str, jax.Array]]:
        """One training step against a policy's `parameters`; metrics (S,) over the episodes that
        ended with it.
        """
        how = self.how
        key, noise_key, order_key, world_key = jax.random.split(carry.key, 4)
        noise = jax.random.normal(noise_key, (how.rollout_length, how.seeds * how.num_envs, 3))
        (observation, state), samples = self._collect(parameters, carry, noise)
        evaders = self.learning.learn(carry.evaders, samples, state, order_key)

        statistics = state.statistics
        over = statistics.captured | (state.step >= self.environment.settings.episode_length)

        def by_seed(values):
            return jnp.sum(jnp.where(over, values, 0.0).reshape(how.seeds, how.num_envs), axis=1)

        episodes = by_seed(1.0)
        number = jnp.maximum(episodes, 1.0)
        metrics = {
            "episodes": episodes,
            "capture_rate": by_seed(statistics.captured) / number,
            "capture_step": by_seed(statistics.capture_step) / number,
        }

        def renew(new, old):
            return jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        observation, state = jax.tree.map(renew, self._fresh(world_key), (observation, state))
        carry = ResponseCarry(evaders, observation, state, key, carry.update + 1)
        return carry, metrics


def make_duel(
    environment: Pursuit, policy: Policy
) -> Callable[[PolicyParameters, Task, jax.Array, jax.Array, dict], EpisodeStatistics]:
    """`duel(parameters, tasks (B, ...), kinds (B,) or (), key, changes) -> statistics (B,)`: whole
    episodes of the mean policy.

    `kinds` are places in the settings' evaders; where one is for all worlds, no other is worked
    out. `changes` are fields of the environment that hold arrays: `evader_networks`, the
    `vehicle_bounds`.
    """

    def duel(parameters, tasks, kinds, key, changes):
        game = dataclasses.replace(environment, **changes)

        def begin(key, task, kind):
            observation, state = game.reset_to(key, task)
            evader_key = jax.random.fold_in(key, 3)
            evader = draw_evader(game.settings, evader_key, task.pursuer_position, kind=kind)
            return observation, state.replace(evader=evader)

        def one(world, _):
            observation, state = world
            action = policy.act(parameters, observation)
            observation, state, *_ = jax.vmap(step, (0, 0, of_worlds))(state, action, kinds)
            return (observation, state), None

        def step(state, action, kind):
            return game.step(key, state.replace(evader=state.evader.replace(kind=kind)), action)

        of_worlds = 0 if kinds.ndim else None
        keys = jax.random.split(key, tasks.evader_position.shape[0])
        world = jax.vmap(begin, (0, 0, of_worlds))(keys, tasks, kinds)
        return jax.lax.scan(one, world, length=game.settings.episode_length)[0][1].statistics

    return duel

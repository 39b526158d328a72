"""A best response to fixed pursuers: an evader learns, by PPO, to be caught as late as it can be.

Payoff is the time to the capture and not whether there is one: where captures are forced, every evader would be as good as any
other. Seeds learn side by side in one compiled step, each with worlds of its own; pursuers fly their mean policy.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from openjax.learning.advantages import generalised_advantages
from openjax.learning.best_response_settings import BestResponseSettings
from openjax.policy import Policy, PolicyParameters, gaussian_entropy, gaussian_log_prob
from openjax.pursuit import (
    EpisodeStatistics,
    Observation,
    Pursuit,
    PursuitState,
    Task,
    turn_task,
    uniform_task,
)
from openjax.pursuit.evaders import draw_evader, init_network, scene_of
from openjax.pursuit.evaders.learned import features, outputs

REWARD = 0.01
"""Of a step without a capture: values are of the order of one."""


@struct.dataclass
class Evader:
    """Learned evaders of S seeds: every leaf has their axis first."""

    actor: Any
    critic: Any
    log_std: jax.Array  # (S, 3)

    @property
    def networks(self) -> tuple[Any, Any, jax.Array]:
        """What learns."""
        return self.actor, self.critic, self.log_std


@struct.dataclass
class ResponseCarry:
    """Everything that a run is; worlds of all seeds one after the other."""

    evader: Evader
    optimiser: Any
    observation: Observation  # (S * E, ...)
    state: PursuitState  # (S * E, ...)
    key: jax.Array
    update: jax.Array  # () int32


@struct.dataclass
class _Samples:
    """T steps of E worlds of S seeds."""

    seen: dict[str, jax.Array]  # (T, S, E, ...)
    sample: jax.Array  # (T, S, E, 3)
    log_prob: jax.Array  # (T, S, E)
    value: jax.Array  # (T, S, E)
    flying: jax.Array  # (T, S, E) bool, not caught before this step
    caught: jax.Array  # (T, S, E) bool, caught after it


@dataclass(frozen=True, eq=False)
class BestResponse:
    """The evader's learning against a policy, as pure functions of a `ResponseCarry`."""

    how: BestResponseSettings
    environment: Pursuit
    """Its settings' evaders are ("learned",)."""
    policy: Policy
    layouts: Task
    """(L, ...)"""

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients, on one vector."""
        steps = self.how.total_updates * self.how.epochs * self.how.minibatches
        rate = optax.linear_schedule(self.how.learning_rate, 0.0, steps)
        return optax.flatten(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, eps=1e-5)))

    def start(self, key: jax.Array) -> ResponseCarry:
        """Evaders that do as the greedy one, and worlds at their starts."""
        key, actor_key, critic_key, world_key = jax.random.split(key, 4)
        seeds = self.how.seeds
        evader = Evader(
            actor=jax.vmap(init_network)(jax.random.split(actor_key, seeds)),
            critic=jax.vmap(init_network)(jax.random.split(critic_key, seeds)),
            log_std=jnp.full((seeds, 3), self.how.initial_log_std),
        )
        observation, state = self._fresh(world_key)
        return ResponseCarry(
            evader=evader,
            optimiser=jax.vmap(self.optimiser.init)(evader.networks),
            observation=observation,
            state=state,
            key=key,
            update=jnp.zeros((), jnp.int32),
        )

    def _fresh(self, key):
        """Observations and states of all worlds at the start of an episode."""

        def task(key):
            uniform_key, turn_key, choice_key, layout_key = jax.random.split(key, 4)
            uniform = turn_task(turn_key, uniform_task(self.environment.settings, uniform_key))
            which = jax.random.randint(layout_key, (), 0, self.layouts.evader_position.shape[0])
            on_layout = jax.random.uniform(choice_key) < self.how.layouts
            return jax.tree.map(lambda a, b: jnp.where(on_layout, a[which], b), self.layouts, uniform)

        def begin(key):
            task_key, reset_key = jax.random.split(key)
            return self.environment.reset_to(reset_key, task(task_key))

        return jax.vmap(begin)(jax.random.split(key, self.how.seeds * self.how.num_envs))

    def _by_seed(self, leaf):
        return leaf.reshape(self.how.seeds, self.how.num_envs, *leaf.shape[1:])

    def _seen(self, state):
        """Features (S, E, ...) of the evaders in worlds (S * E, ...)."""

        def one(state):
            around = self.environment.around_evader(state)
            return features(scene_of(self.environment.settings, state.evader, around), state.evader.memory)

        return jax.tree.map(self._by_seed, jax.vmap(one)(state))

    def _collect(self, parameters, carry, noise):
        """`_Samples`, and observation and state after them; noise (T, S, E, 3)."""
        evader, key = carry.evader, jax.random.key(0)
        step = jax.vmap(self.environment.step, in_axes=(None, 0, 0, 0))

        def one(world, noise):
            observation, state = world
            action = self.policy.act(parameters, observation)
            seen = self._seen(state)
            mean = jax.vmap(outputs)(evader.actor, seen)[0]
            value = jax.vmap(outputs)(evader.critic, seen)[1]
            sample = mean + jnp.exp(evader.log_std[:, None]) * noise
            flying = ~self._by_seed(state.statistics.captured)
            observation, state, *_ = step(key, state, action, sample.reshape(-1, 3))
            record = _Samples(
                seen=seen,
                sample=sample,
                log_prob=jax.vmap(gaussian_log_prob)(sample, mean, evader.log_std),
                value=value,
                flying=flying,
                caught=self._by_seed(state.statistics.captured),
            )
            return (observation, state), record

        (observation, state), samples = jax.lax.scan(one, (carry.observation, carry.state), noise)
        return samples, observation, state

    def _loss(self, networks, batch):
        """() of one seed; batch: seen, sample, log_prob, advantage, target, weight, all (n, ...)."""
        actor, critic, log_std = networks
        seen, sample, log_prob, advantage, target, weight = batch
        ratio = jnp.exp(gaussian_log_prob(sample, outputs(actor, seen)[0], log_std) - log_prob)
        clipped = jnp.clip(ratio, 1.0 - self.how.clip_epsilon, 1.0 + self.how.clip_epsilon)
        surrogate = jnp.minimum(ratio * advantage, clipped * advantage)
        error = (outputs(critic, seen)[1] - target) ** 2
        mean = jnp.sum(weight * (0.5 * error - surrogate)) / jnp.maximum(jnp.sum(weight), 1.0)
        return mean - self.how.entropy_coefficient * gaussian_entropy(log_std)

    def _batch(self, samples, last_value):
        """What a gradient step needs of samples (see `_loss`), each (minibatches, S, n, ...), whole worlds together."""
        how = self.how
        following = jnp.concatenate([samples.value[1:], last_value[None]])
        advantage = generalised_advantages(
            REWARD * (~samples.caught).astype(jnp.float32),
            samples.value,
            following,
            samples.caught,
            jnp.zeros_like(samples.caught),
            how.discount,
            how.gae_lambda,
        )
        target, weight = advantage + samples.value, samples.flying.astype(jnp.float32)

        def mean(value):
            return jnp.sum(weight * value, (0, 2), keepdims=True) / jnp.maximum(
                jnp.sum(weight, (0, 2), keepdims=True), 1.0
            )

        centred = advantage - mean(advantage)
        advantage = centred / (jnp.sqrt(mean(centred**2)) + 1e-8)

        def parts(leaf):
            steps, seeds, worlds = leaf.shape[:3]
            leaf = leaf.reshape(steps, seeds, how.minibatches, worlds // how.minibatches, *leaf.shape[3:])
            leaf = jnp.moveaxis(leaf, (2, 1), (0, 1))
            return leaf.reshape(how.minibatches, seeds, -1, *leaf.shape[4:])

        batch = (samples.seen, samples.sample, samples.log_prob, advantage, target, weight)
        return jax.tree.map(parts, batch)

    def _learn(self, carry, samples, last_value, key):
        """Evader and optimiser's state after all epochs on the samples."""
        how, batch = self.how, self._batch(samples, last_value)

        def step(carry, index):
            networks, state = carry
            part = jax.tree.map(lambda leaf: leaf[index], batch)
            gradient = jax.vmap(jax.grad(self._loss))(networks, part)
            change, state = jax.vmap(self.optimiser.update)(gradient, state, networks)
            return (optax.apply_updates(networks, change), state), None

        order = jax.vmap(lambda key: jax.random.permutation(key, how.minibatches))(
            jax.random.split(key, how.epochs)
        )
        start = carry.evader.networks, carry.optimiser
        (networks, state), _ = jax.lax.scan(step, start, order.ravel())
        return Evader(*networks), state

    def step(
        self, parameters: PolicyParameters, carry: ResponseCarry
    ) -> tuple[ResponseCarry, dict[str, jax.Array]]:
        """One training step against a policy's `parameters`; metrics (S,) over the episodes that ended with it."""
        how = self.how
        key, noise_key, order_key, world_key = jax.random.split(carry.key, 4)
        shape = (how.rollout_length, how.seeds, how.num_envs, 3)
        samples, observation, state = self._collect(parameters, carry, jax.random.normal(noise_key, shape))
        last_value = jax.vmap(outputs)(carry.evader.critic, self._seen(state))[1]
        evader, optimiser = self._learn(carry, samples, last_value, order_key)

        over = state.statistics.captured | (state.step >= self.environment.settings.episode_length)
        ended = self._by_seed(over).astype(jnp.float32)
        number = jnp.maximum(jnp.sum(ended, axis=1), 1.0)
        statistics = jax.tree.map(self._by_seed, state.statistics)
        metrics = {
            "episodes": jnp.sum(ended, axis=1),
            "capture_rate": jnp.sum(ended * statistics.captured, axis=1) / number,
            "capture_step": jnp.sum(ended * statistics.capture_step, axis=1) / number,
        }

        def renew(new, old):
            return jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        observation, state = jax.tree.map(renew, self._fresh(world_key), (observation, state))
        return (
            ResponseCarry(
                evader=evader,
                optimiser=optimiser,
                observation=observation,
                state=state,
                key=key,
                update=carry.update + 1,
            ),
            metrics,
        )


def make_duel(
    environment: Pursuit, policy: Policy
) -> Callable[[PolicyParameters, Task, jax.Array, jax.Array, dict], EpisodeStatistics]:
    """`duel(parameters, tasks (B, ...), kinds (B,) or (), key, changes) -> statistics (B,)`: whole episodes of the mean policy.

    `kinds` are places in the settings' evaders; where one is for all worlds, no other is worked out. `changes` are fields of
    the environment that hold arrays: the learned evader's `evader_network`, the `vehicle_bounds`.
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

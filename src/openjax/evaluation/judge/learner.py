"""Evaders that learn a best response to a fixed policy, by PPO, several side by side.

An evader decides every `hold` control steps and flies its decision until the next one: noise that
is new in every step of 10 ms averages out before a point has moved two centimetres. Its reward is
the time that it is free, and its foresight is seconds. It starts from nothing, as no evader of the
library does: an evader that starts as a greedy one stays one.

PPO: Schulman et al., 2017, arXiv 1707.06347; advantages: Schulman et al., 2016, arXiv 1506.02438.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from openjax.evaluation.judge.networks import apply_network, init_network
from openjax.evaluation.judge.senses import sense, to_world
from openjax.evaluation.judge.settings import JudgeSettings
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitState, Task


@struct.dataclass
class Evaders:
    """L learners."""

    actor: dict[str, jax.Array]
    critic: dict[str, jax.Array]
    log_std: jax.Array  # (L, 3)
    world_axes: jax.Array  # (L,) bool
    discount: jax.Array  # (L,), of a decision

    @property
    def networks(self) -> tuple[Any, Any, jax.Array]:
        """What learns."""
        return self.actor, self.critic, self.log_std


@struct.dataclass
class JudgeCarry:
    """Everything that a judge's run is; E worlds of each learner."""

    evaders: Evaders
    optimiser: Any
    observation: Observation  # (L * E, ...), learner by learner
    state: PursuitState  # (L * E, ...)
    key: jax.Array


@struct.dataclass
class Decisions:
    """T decisions in L * E worlds."""

    sensed: jax.Array  # (T, L * E, F)
    sample: jax.Array  # (T, L * E, 3)
    log_prob: jax.Array  # (T, L * E)
    free: jax.Array  # (T, L * E), share of the decision's steps in which the evader was free
    over: jax.Array  # (T, L * E) bool, caught or out of time at its end


@dataclass(frozen=True, eq=False)
class Judge:
    """The learners against a policy's mean, as pure functions of a `JudgeCarry`."""

    settings: JudgeSettings
    environment: Pursuit
    policy: Policy
    draw_task: Callable[[jax.Array], Task]
    """key -> a task to learn on"""

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Of all learners at once: Adam treats each number by itself, the norm is each one's."""
        settings = self.settings
        rate = optax.linear_schedule(settings.learning_rate, 0.0, settings.gradient_steps)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, eps=1e-5))

    def start(self, key: jax.Array) -> JudgeCarry:
        """Evaders that do nothing but tremble, and worlds at their starts."""
        key, actor_key, critic_key, world_key = jax.random.split(key, 4)
        learners = self.settings.learners
        observation, state = self._fresh(world_key)
        one = jax.tree.map(lambda leaf: leaf[0], state)
        inputs = sense(self.environment.settings, one, jnp.bool_(False)).size
        evaders = Evaders(
            actor=init_network(actor_key, learners, inputs, 3),
            critic=init_network(critic_key, learners, inputs, 1),
            log_std=jnp.full((learners, 3), self.settings.initial_log_std, jnp.float32),
            world_axes=jnp.arange(learners) % 2 == 1,
            discount=jnp.asarray(self.settings.discounts(self.environment.settings.time_step)),
        )
        state_of = jax.vmap(self.optimiser.init)
        return JudgeCarry(evaders, state_of(evaders.networks), observation, state, key)

    def step(
        self, parameters: PolicyParameters, carry: JudgeCarry
    ) -> tuple[JudgeCarry, dict[str, jax.Array]]:
        """One rollout and one update; metrics (L,): share of the time free, episodes that ended,
        share of them that ended with a capture.
        """
        key, noise_key, world_key, order_key = jax.random.split(carry.key, 4)
        observation, state, decisions, captures = self._collect(
            parameters, carry, noise_key, self._fresh(world_key)
        )
        evaders, optimiser = self._learn(carry, decisions, state, order_key)
        ended = self._by_learner(decisions.over).astype(jnp.float32)
        metrics = {
            "free": jnp.mean(self._by_learner(decisions.free), (0, 2)),
            "episodes": jnp.sum(ended, (0, 2)),
            "capture_rate": jnp.sum(self._by_learner(captures), (0, 2))
            / jnp.maximum(jnp.sum(ended, (0, 2)), 1.0),
        }
        return JudgeCarry(evaders, optimiser, observation, state, key), metrics

    def _by_learner(self, values):
        """(T, L, E, ...) of (T, L * E, ...)."""
        learners = self.settings.learners
        return values.reshape(values.shape[0], learners, -1, *values.shape[2:])

    def _fresh(self, key):
        """Observations and states of all worlds at the start of an episode."""

        def begin(key):
            task_key, reset_key = jax.random.split(key)
            return self.environment.reset_to(reset_key, self.draw_task(task_key))

        number = self.settings.learners * self.settings.num_envs
        return jax.vmap(begin)(jax.random.split(key, number))

    def _sense(self, evaders, state):
        """(L, E, F) of worlds (L * E, ...)."""
        axes = jnp.repeat(evaders.world_axes, self.settings.num_envs)
        sensed = jax.vmap(functools.partial(sense, self.environment.settings))(state, axes)
        return sensed.reshape(self.settings.learners, self.settings.num_envs, -1)

    def _collect(self, parameters, carry, key, fresh):
        """Worlds after T decisions, the decisions, and (T, L * E) whether one ended in a capture.

        A world whose evader is caught goes on at once, at the start that `fresh` has for it: where
        it is caught twice in a rollout, at the same one again.
        """
        settings = self.settings
        evaders = carry.evaders
        worlds = settings.learners * settings.num_envs
        log_std = evaders.log_std[:, None]
        axes = jnp.repeat(evaders.world_axes, settings.num_envs)

        def decide(world, key):
            observation, state = world
            sensed = self._sense(evaders, state)
            mean = apply_network(evaders.actor, sensed)
            sample = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
            log_prob = _log_prob(sample, mean, log_std)
            wish = jax.vmap(to_world)(sample.reshape(worlds, 3), state, axes)
            observation, state = self.fly(parameters, observation, state, wish)
            statistics = state.statistics
            # of a decision in which it was caught, the steps before that
            late = jnp.maximum(state.step - statistics.capture_step + 1, 0) / settings.hold
            free = jnp.where(statistics.captured, 1.0 - jnp.minimum(late, 1.0), 1.0)
            over = statistics.captured | (state.step >= self.environment.settings.episode_length)

            def renew(new, old):
                return jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old)

            world = jax.tree.map(renew, fresh, (observation, state))
            decisions = Decisions(
                sensed.reshape(worlds, -1),
                sample.reshape(worlds, 3),
                log_prob.reshape(worlds),
                free,
                over,
            )
            return world, (decisions, statistics.captured)

        keys = jax.random.split(key, settings.rollout_length)
        start = (carry.observation, carry.state)
        (observation, state), (decisions, captures) = jax.lax.scan(decide, start, keys)
        return observation, state, decisions, captures

    def fly(
        self,
        parameters: PolicyParameters,
        observation: Observation,
        state: PursuitState,
        wish: jax.Array,
    ) -> tuple[Observation, PursuitState]:
        """Worlds (B, ...) after the `hold` control steps of a decision (B, 3)."""
        return fly_decision(
            self.environment, self.policy, parameters, (observation, state), wish, self.settings.hold
        )

    def _learn(self, carry, decisions, state, key):
        """The evaders and their optimiser after all epochs."""
        settings = self.settings
        evaders = carry.evaders
        batch = self._batch(evaders, decisions, state)
        size = batch["free"].shape[1] // settings.minibatches

        def epoch(networks_and_state, key):
            order = jax.random.permutation(key, batch["free"].shape[1])
            shuffled = jax.tree.map(lambda leaf: leaf[:, order], batch)

            def update(networks_and_state, i):
                networks, state = networks_and_state

                def part(leaf):
                    return jax.lax.dynamic_slice_in_dim(leaf, i * size, size, axis=1)

                gradient = jax.grad(self._loss)(networks, jax.tree.map(part, shuffled))
                change, state = jax.vmap(self.optimiser.update)(gradient, state, networks)
                return (optax.apply_updates(networks, change), state), None

            indices = jnp.arange(settings.minibatches)
            return jax.lax.scan(update, networks_and_state, indices)[0], None

        start = evaders.networks, carry.optimiser
        keys = jax.random.split(key, settings.epochs)
        (networks, optimiser), _ = jax.lax.scan(epoch, start, keys)
        actor, critic, log_std = networks
        log_std = jnp.maximum(log_std, settings.least_log_std)
        return evaders.replace(actor=actor, critic=critic, log_std=log_std), optimiser

    def _batch(self, evaders, decisions, state):
        """(L, T * E, ...) by name: what the loss needs."""
        sensed = self._by_learner(decisions.sensed)  # (T, L, E, F)
        of_steps = jax.vmap(lambda sensed: apply_network(evaders.critic, sensed)[..., 0])
        value = of_steps(sensed)  # (T, L, E)
        last = apply_network(evaders.critic, self._sense(evaders, state))[..., 0]
        discount = evaders.discount[:, None]
        free = self._by_learner(decisions.free)
        over = self._by_learner(decisions.over)

        def back(carry, step):
            advantage, following = carry
            free, over, value = step
            # values are shares of the time to come: at most one
            target = (1.0 - discount) * free + discount * jnp.where(over, 0.0, following)
            trace = discount * self.settings.gae_lambda * jnp.where(over, 0.0, advantage)
            advantage = target - value + trace
            return (advantage, value), advantage

        start = (jnp.zeros_like(last), last)
        advantage = jax.lax.scan(back, start, (free, over, value), reverse=True)[1]
        centred = advantage - jnp.mean(advantage, (0, 2), keepdims=True)
        normal = centred / (jnp.std(advantage, (0, 2), keepdims=True) + 1e-8)
        rows = {
            "sensed": sensed,
            "sample": self._by_learner(decisions.sample),
            "log_prob": self._by_learner(decisions.log_prob),
            "free": free,
            "advantage": normal,
            "target": advantage + value,
        }

        def flat(leaf):
            moved = jnp.moveaxis(leaf, 0, 1)
            return moved.reshape(moved.shape[0], -1, *moved.shape[3:])

        return jax.tree.map(flat, rows)

    def _loss(self, networks, part):
        """(), the sum over learners: none's gradient knows of another."""
        settings = self.settings
        actor, critic, log_std = networks
        mean = apply_network(actor, part["sensed"])
        log_prob = _log_prob(part["sample"], mean, log_std[:, None])
        ratio = jnp.exp(log_prob - part["log_prob"])
        clipped = jnp.clip(ratio, 1.0 - settings.clip_epsilon, 1.0 + settings.clip_epsilon)
        surrogate = jnp.minimum(ratio * part["advantage"], clipped * part["advantage"])
        value = apply_network(critic, part["sensed"])[..., 0]
        # a value is at most one, an advantage of one standard deviation some hundredths
        error = settings.value_coefficient * (value - part["target"]) ** 2
        entropy = settings.entropy_coefficient * jnp.sum(log_std, -1)
        return jnp.sum(jnp.mean(error - surrogate, axis=1) - entropy)


def fly_decision(
    environment: Pursuit,
    policy: Policy,
    parameters: PolicyParameters,
    world: tuple[Observation, PursuitState],
    wish: jax.Array,
    hold: int,
) -> tuple[Observation, PursuitState]:
    """Worlds (B, ...) after `hold` control steps against the mean policy, the evader at `wish`
    (B, 3), shares of its speed.
    """
    key = jax.random.key(0)
    step = jax.vmap(environment.step, in_axes=(None, 0, 0, 0))

    def one(world, _):
        observation, state = world
        action = policy.act(parameters, observation)
        observation, state, *_ = step(key, state, action, wish)
        return (observation, state), None

    return jax.lax.scan(one, world, length=hold)[0]


def decide(
    settings: Any, evaders: Evaders, state: PursuitState, place: jax.Array
) -> jax.Array:
    """(B, 3) wishes, without noise, of the learners at `place` (B,) in worlds (B, ...)."""
    axes = evaders.world_axes[place]
    sensed = jax.vmap(functools.partial(sense, settings))(state, axes)
    everyone = jnp.broadcast_to(sensed, (evaders.world_axes.size, *sensed.shape))
    means = apply_network(evaders.actor, everyone)
    chosen = jax.nn.one_hot(place, means.shape[0], axis=0)
    return jax.vmap(to_world)(jnp.sum(chosen[..., None] * means, axis=0), state, axes)


def _log_prob(sample, mean, log_std):
    scaled = (sample - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * scaled**2 - log_std - 0.5 * np.log(2 * np.pi), axis=-1)

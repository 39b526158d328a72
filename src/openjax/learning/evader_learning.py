"""Evaders that learn, by PPO, to be caught as late as they can be.

Payoff is the time to the capture and not whether there is one: where captures are forced, every evader would be as good as any
other. A game names `learned` among its evaders as often as there are networks; the world of one of them is flown by its samples,
and it learns from these until it is caught. `openjax.learning.training_step` has them learn while the pursuers do,
`openjax.learning.best_response` against fixed ones.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from openjax.learning.advantages import generalised_advantages
from openjax.learning.collectives import mean_over_devices, minibatches
from openjax.learning.evader_pool import EvaderPool, paid, renewed, start_pool, with_drawn
from openjax.learning.settings import EvaderLearningSettings
from openjax.learning.train_state import clipped_adam, shuffled
from openjax.policy import gaussian_divergence, gaussian_entropy, gaussian_log_prob
from openjax.pursuit import Pursuit, PursuitState
from openjax.pursuit.evaders import init_network, learned_place, scene_of
from openjax.pursuit.evaders.learned import features, outputs, outputs_of

REWARD = 0.01
"""Of a step without a capture: values are of the order of one."""


@struct.dataclass
class LearningEvaders:
    """L networks that learn: every leaf of theirs has their axis first."""

    actor: Any
    critic: Any
    log_std: jax.Array  # (L, 3)
    optimiser: Any
    reference: tuple[Any, jax.Array] | None = None
    """Earlier actor and log_std, (L, ...); None without a divergence."""
    pool: EvaderPool | None = None
    """What flies in the other places; None where all learn."""
    updates: jax.Array | None = None
    """() int32, updates done; None where nobody asks."""

    @property
    def networks(self) -> tuple[Any, Any, jax.Array]:
        """What learns."""
        return self.actor, self.critic, self.log_std

    @property
    def flying(self) -> "LearningEvaders":
        """What acts: with the actors and log_std of all K places, those that learn first."""
        if self.pool is None:
            return self
        actor, log_std = with_drawn(self.pool, (self.actor, self.log_std))
        return self.replace(actor=actor, log_std=log_std, pool=None)


@struct.dataclass
class EvaderSamples:
    """T steps of E worlds."""

    seen: dict[str, jax.Array]  # (T, E, ...)
    which: jax.Array  # (T, E) int32, the network; -1: an evader that learns nothing
    sample: jax.Array  # (T, E, 3)
    log_prob: jax.Array  # (T, E)
    flying: jax.Array  # (T, E) bool, not caught before this step


@dataclass(frozen=True, eq=False)
class EvaderLearning:
    """How the learned evaders of a game learn, as pure functions."""

    how: EvaderLearningSettings
    environment: Pursuit
    updates: int
    """Of the run."""

    @property
    def number(self) -> int:
        """Networks that fly; 0: none learns, as the game names none, or brings their networks with it."""
        brought = self.environment.evader_networks is not None
        return 0 if brought else self.environment.settings.evaders.count("learned")

    @property
    def learners(self) -> int:
        """Networks that learn, the first ones."""
        return min(self.number, 1) if self.how.pool else self.number

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Of each network."""
        how, steps = self.how, self.updates * self.how.epochs * self.how.minibatches
        rate = optax.linear_schedule(how.learning_rate, how.learning_rate_end, steps)
        return clipped_adam(1.0, rate)

    def start(self, key: jax.Array) -> LearningEvaders:
        """Evaders that do as greedy ones."""
        keys = jax.vmap(lambda key: jax.random.split(key, self.number))(jax.random.split(key))
        log_std = jnp.full((self.number, 3), self.how.initial_log_std, jnp.float32)
        init = jax.vmap(functools.partial(init_network, own_axes=self.how.own_axes))
        networks = *(init(own, jnp.arange(self.number)) for own in keys), log_std
        pool = start_pool(networks[0], log_std, self.how.pool) if self.how.pool else None
        if pool is not None:
            networks = jax.tree.map(lambda leaf: leaf[: self.learners], networks)
        reference = (networks[0], networks[2]) if self.how.reference_kl else None
        updates = jnp.zeros((), jnp.int32) if self.how.pool or self.how.reference_kl else None
        optimiser = jax.vmap(self.optimiser.init)(networks)
        return LearningEvaders(*networks, optimiser, reference, pool, updates)

    def see(self, networks: Any, state: PursuitState) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Of worlds (E, ...) which of the networks acts, (E,), and what it sees."""
        settings = self.environment.settings
        which = learned_place(settings.evaders, state.evader.kind)

        def one(which, state):
            return features(networks, which, scene_of(settings, state), state.evader.memory)

        return which, jax.vmap(one)(which, state)

    def act(
        self, evaders: LearningEvaders, state: PursuitState, noise: jax.Array
    ) -> tuple[jax.Array, EvaderSamples]:
        """Wishes (E, 3) in worlds (E, ...), NaN where none of the networks acts, and the samples; noise (E, 3).

        `evaders` are those that are `flying`.
        """
        which, seen = self.see(evaders.actor, state)
        mean = outputs_of(evaders.actor, which, seen)[0]
        log_std = jax.nn.one_hot(which, self.number) @ evaders.log_std
        sample = mean + jnp.exp(log_std) * noise
        log_prob = jax.vmap(gaussian_log_prob)(sample, mean, log_std)
        samples = EvaderSamples(seen, which, sample, log_prob, ~state.statistics.captured)
        return jax.lax.optimization_barrier(jnp.where((which >= 0)[:, None], sample, jnp.nan)), samples

    def learn(
        self,
        evaders: LearningEvaders,
        samples: EvaderSamples,
        last: PursuitState,
        key: jax.Array,
        axis: str | None = None,
    ) -> LearningEvaders:
        """The evaders after all epochs on samples (T, E, ...), which ended in worlds `last` (E, ...).

        `key` shuffles, the same on all devices; `axis` is the name of the devices' axis.
        """
        how, (worlds, batch) = self.how, self._batch(evaders, samples, last, axis)

        def step(carry, index):
            networks, state = carry
            gradient = self._gradient(networks, *jax.tree.map(lambda leaf: leaf[index], (worlds, batch)))
            gradient = mean_over_devices(gradient, axis)
            change, state = jax.vmap(self.optimiser.update)(gradient, state, networks)
            return (optax.apply_updates(networks, change), state), None

        start = evaders.networks, evaders.optimiser
        order = shuffled(key, how.epochs, how.minibatches)
        (networks, state), _ = jax.lax.scan(step, start, order)
        actor, critic, log_std = networks
        evaders = evaders.replace(actor=actor, critic=critic, log_std=log_std, optimiser=state)
        return self._remembered(evaders, samples, last, jax.random.fold_in(key, 1), axis)

    def _remembered(self, evaders, samples, last, key, axis):
        """The evaders with reference and pool after an update."""
        if evaders.updates is None:
            return evaders
        how, updates, learner = self.how, evaders.updates + 1, (evaders.actor, evaders.log_std)
        reference, pool = evaders.reference, evaders.pool
        if reference is not None:
            due = updates % how.reference_every == 0
            reference = jax.tree.map(lambda new, old: jnp.where(due, new, old), learner, reference)
        if pool is not None:
            rollouts = evaders.updates % how.pool_every + 1
            begun = last.statistics.steps <= rollouts * samples.flying.shape[0]
            pool = paid(pool, samples.which[0], samples.flying, begun, axis)
            pool = renewed(how, pool, learner, updates, key)
        return evaders.replace(reference=reference, pool=pool, updates=updates)

    def _by_network(self, which):
        """(..., L) of (...,): one for the network, zero for the others and where none of them learns."""
        return jax.nn.one_hot(which, self.learners)

    def _gradient(self, networks, worlds, part):
        """Of the networks' losses, each from its own worlds alone: some of them at a time, as often as the busiest one needs.

        worlds: the networks' numbers of worlds (L,) and all worlds (L, W), each network's own ones first; part: see `_loss`.
        """
        (number, order), kinds = worlds, len(self.environment.settings.evaders)
        some = order.shape[1] // max(n for n in range(1, kinds + 1) if order.shape[1] % n == 0)

        def add(i, total):
            place = i * some + jnp.arange(some)
            own = jax.tree.map(lambda leaf: leaf[order[:, place]], part)
            gradient = jax.vmap(jax.grad(self._loss))(networks, place < number[:, None], own)
            return jax.tree.map(lambda total, some: total + some / order.shape[1], total, gradient)

        rounds = jnp.max(-(-number // some))
        return jax.lax.fori_loop(0, rounds, add, jax.tree.map(jnp.zeros_like, networks))

    def _loss(self, networks, own, part):
        """() of one network, the sum over worlds of the mean over steps; own (n,) whether a world is the network's; part: seen,
        sample, log_prob, weight, advantage, target, the reference's mean and log_std or None, all (n, T, ...)."""
        actor, critic, log_std = networks
        seen, sample, log_prob, weight, advantage, target, reference = part
        weight, mean = own[:, None] * weight, outputs(actor, seen)[0]
        log_ratio = gaussian_log_prob(sample, mean, log_std) - log_prob
        # samples of other networks count for nothing, and mustn't overflow
        ratio = jnp.exp(jnp.where(weight > 0.0, log_ratio, 0.0))
        clipped = jnp.clip(ratio, 1.0 - self.how.clip_epsilon, 1.0 + self.how.clip_epsilon)
        surrogate = jnp.minimum(ratio * advantage, clipped * advantage)
        error = (outputs(critic, seen)[1] - target) ** 2
        # weighted too: before the first of its worlds begins, a network's noise stays as it is
        entropy = self.how.entropy_coefficient * gaussian_entropy(log_std)
        loss = 0.5 * error - surrogate - entropy
        if reference is not None:
            loss += self.how.reference_kl * gaussian_divergence(mean, log_std, *reference)
        return jnp.sum(jnp.mean(weight * loss, axis=1))

    def _batch(self, evaders, samples, last, axis):
        """What gradient steps need, minibatch by minibatch: see `_gradient` and `_loss`."""
        how, critic = self.how, evaders.critic
        value = outputs_of(critic, samples.which, samples.seen)[1]
        last_value = outputs_of(critic, *self.see(evaders.flying.actor, last))[1]
        caught = jnp.concatenate([~samples.flying[1:], last.statistics.captured[None]])
        advantage = generalised_advantages(
            REWARD * (~caught).astype(jnp.float32),
            value,
            jnp.concatenate([value[1:], last_value[None]]),
            caught,
            jnp.zeros_like(caught),
            how.discount,
            how.gae_lambda,
        )
        # a world keeps its evader until the rollout's end
        flying = samples.flying[..., None] * self._by_network(samples.which[0])  # (T, E, L)
        scale = 1.0 / jnp.maximum(mean_over_devices(jnp.mean(flying, (0, 1)), axis), 1e-4)
        weight = jnp.sum(scale * flying, axis=-1)

        def mean(x):
            """Of what each sample's network met, (T, E)."""
            by_network = mean_over_devices(jnp.mean(scale * flying * x[..., None], (0, 1)), axis)
            return self._by_network(samples.which[0]) @ by_network

        centred = advantage - mean(advantage)
        normal = centred / (jnp.sqrt(mean(centred**2)) + 1e-8)
        batch = samples.seen, samples.sample, samples.log_prob, weight, normal, advantage + value
        batch += (self._told(evaders.reference, samples),)
        which = minibatches(samples.which[:1], how.minibatches)[..., 0]  # (M, W)
        own = which[:, None] == jnp.arange(self.learners)[:, None]
        worlds = jnp.sum(own, axis=-1), jnp.argsort(~own, axis=-1)
        return worlds, minibatches(batch, how.minibatches)

    def _told(self, reference, samples):
        """What the reference's Gaussians are at the samples: mean and log_std, (T, E, 3) both; None without one."""
        if reference is None:
            return None
        actor, log_std = reference
        mean = outputs_of(actor, samples.which, samples.seen)[0]
        return mean, jnp.sum(self._by_network(samples.which)[..., None] * log_std, axis=-2)

"""Evaders that learn, by PPO, to be caught as late as they can be.

Payoff is the time to the capture and not whether there is one: where captures are forced, every
evader would be as good as any other. A game names `learned` among its evaders as often as there are
networks; the world of one of them is flown by its samples, and it learns from these until it is
caught. `openjax.learning.training_step` has them learn while the pursuers do. They judge nobody:
`openjax.evaluation.judges` shares nothing with them.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from openjax.learning.advantages import generalised_advantages
from openjax.learning.collectives import mean_over_devices, minibatches
from openjax.learning.settings import EvaderLearningSettings
from openjax.learning.train_state import clipped_adam, shuffled
from openjax.policy import gaussian_entropy, gaussian_log_prob
from openjax.pursuit import Pursuit, PursuitState
from openjax.pursuit.evaders import init_network, learned_place, scene_of
from openjax.pursuit.evaders.learned import features, outputs, outputs_of

REWARD = 0.01
"""Of a step without a capture: values are of the order of one."""


@struct.dataclass
class LearningEvaders:
    """K networks: every leaf has their axis first."""

    actor: Any
    critic: Any
    log_std: jax.Array  # (K, 3)
    optimiser: Any
    pool: Any
    """(P, ...) actors as they once were"""
    past: jax.Array  # (S,) int32, places in the pool of those that fly
    update: jax.Array  # () int32
    born: jax.Array  # (K,) int32, the update in which each began

    @property
    def flying(self) -> Any:
        """(K + S, ...) the actors, and the earlier selves."""

        def joined(actor, pool):
            return jnp.concatenate([actor, pool[self.past]])

        return jax.tree.map(joined, self.actor, self.pool)

    @property
    def networks(self) -> tuple[Any, Any, jax.Array]:
        """What learns."""
        return self.actor, self.critic, self.log_std


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
        """Networks; 0: none learns, as the game names none."""
        named = self.environment.settings.evaders.count("learned")
        return named - self.how.past if named else 0

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Of each network; its steps are scaled by `_rate`."""
        return clipped_adam(1.0, 1.0)

    @property
    def lives(self) -> np.ndarray:
        """(K,) updates for which each network learns."""
        how = self.how
        restarted = np.arange(self.number) < how.restarts
        return np.where(restarted, how.restarts * how.restart_every, self.updates)

    def _rate(self, evaders):
        """(K,) step sizes: they fall over each network's life."""
        done = jnp.clip((evaders.update - evaders.born) / self.lives, 0.0, 1.0)
        return self.how.learning_rate + done * (self.how.learning_rate_end - self.how.learning_rate)

    def start(self, key: jax.Array) -> LearningEvaders:
        """Evaders that do as greedy ones, or nothing."""
        networks = self._fresh(key)
        places = jnp.arange(self.how.pool) % self.number
        return LearningEvaders(
            *networks,
            optimiser=jax.vmap(self.optimiser.init)(networks),
            pool=jax.tree.map(lambda leaf: leaf[places], networks[0]),
            past=jnp.arange(self.how.past, dtype=jnp.int32) % self.how.pool,
            update=jnp.zeros((), jnp.int32),
            born=jnp.zeros(self.number, jnp.int32),
        )

    def _fresh(self, key):
        """Networks that have learnt nothing: actors, critics, spreads."""
        keys = jax.vmap(lambda key: jax.random.split(key, self.number))(jax.random.split(key))
        log_std = jnp.full((self.number, 3), self.how.initial_log_std, jnp.float32)
        init = jax.vmap(functools.partial(init_network, own_axes=self.how.own_axes))
        return *(init(own, jnp.arange(self.number)) for own in keys), log_std

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
        """Wishes (E, 3) in worlds (E, ...), NaN where none of the networks acts, and the samples;
        noise (E, 3).
        """
        flying = evaders.flying
        which, seen = self.see(flying, state)
        mean = outputs_of(flying, which, seen)[0]
        # earlier selves tremble as much as the others do on average
        usual = jnp.mean(evaders.log_std, 0)
        spread = [evaders.log_std, jnp.broadcast_to(usual, (self.how.past, 3))]
        log_std = jax.nn.one_hot(which, self.number + self.how.past) @ jnp.concatenate(spread)
        sample = mean + jnp.exp(log_std) * noise
        log_prob = jax.vmap(gaussian_log_prob)(sample, mean, log_std)
        samples = EvaderSamples(seen, which, sample, log_prob, ~state.statistics.captured)
        return jax.lax.optimization_barrier(
            jnp.where((which >= 0)[:, None], sample, jnp.nan)
        ), samples

    def learn(
        self,
        evaders: LearningEvaders,
        samples: EvaderSamples,
        last: PursuitState,
        key: jax.Array,
        axis: str | None = None,
    ) -> LearningEvaders:
        """The evaders after all epochs on samples (T, E, ...), which ended in worlds `last` (E,
        ...).

        `key` shuffles, the same on all devices; `axis` is the name of the devices' axis.
        """
        how, (worlds, batch) = self.how, self._batch(evaders, samples, last, axis)
        rate = self._rate(evaders)

        def scaled(change):
            return jax.tree.map(lambda leaf: jax.vmap(jnp.multiply)(rate, leaf), change)

        def step(carry, index):
            networks, state = carry
            gradient = self._gradient(
                networks, *jax.tree.map(lambda leaf: leaf[index], (worlds, batch))
            )
            gradient = mean_over_devices(gradient, axis)
            change, state = jax.vmap(self.optimiser.update)(gradient, state, networks)
            return (optax.apply_updates(networks, scaled(change)), state), None

        start = evaders.networks, evaders.optimiser
        order = shuffled(key, how.epochs, how.minibatches)
        (networks, state), _ = jax.lax.scan(step, start, order)
        actor, critic, log_std = networks
        evaders = evaders.replace(
            actor=actor,
            critic=critic,
            log_std=log_std,
            optimiser=state,
            update=evaders.update + 1,
        )
        if how.restarts:
            return self._restart(evaders, jax.random.fold_in(key, 1))
        return self._remember(evaders, jax.random.fold_in(key, 1)) if how.past else evaders

    def _restart(self, evaders, key):
        """Now and then the oldest of those that restart takes a place in the pool, and one that has
        learnt nothing its own; now and then other earlier selves fly.
        """
        how = self.how
        turn, rest = jnp.divmod(evaders.update, how.restart_every)
        due = (rest == 0) & (turn > 0)
        network, place = (turn - 1) % how.restarts, (turn - 1) % how.pool
        fresh = self._fresh(jax.random.fold_in(key, 0))
        fresh = fresh, jax.vmap(self.optimiser.init)(fresh)
        mine = due & (jnp.arange(self.number) == network)

        def begun(fresh, old):
            return jax.vmap(jnp.where)(mine, fresh, old)

        (actor, critic, log_std), optimiser = jax.tree.map(
            begun, fresh, (evaders.networks, evaders.optimiser)
        )
        pool = jax.tree.map(
            lambda pool, old: pool.at[place].set(jnp.where(due, old[network], pool[place])),
            evaders.pool,
            evaders.actor,
        )
        filled = jnp.clip(turn, 1, how.pool)
        drawn = jax.random.randint(jax.random.fold_in(key, 1), (how.past,), 0, filled)
        return evaders.replace(
            actor=actor,
            critic=critic,
            log_std=log_std,
            optimiser=optimiser,
            pool=pool,
            past=jnp.where(evaders.update % how.pool_every == 0, drawn, evaders.past),
            born=jnp.where(mine, evaders.update, evaders.born),
        )

    def _remember(self, evaders, key):
        """Now and then one of the actors takes a place in the pool, and other earlier selves fly."""
        due = evaders.update % self.how.pool_every == 0
        network_key, place_key, past_key = jax.random.split(key, 3)
        network = jax.random.randint(network_key, (), 0, self.number)
        place = jax.random.randint(place_key, (), 0, self.how.pool)
        drawn = jax.random.randint(past_key, (self.how.past,), 0, self.how.pool)

        def kept(pool, actor):
            return pool.at[place].set(jnp.where(due, actor[network], pool[place]))

        pool = jax.tree.map(kept, evaders.pool, evaders.actor)
        return evaders.replace(pool=pool, past=jnp.where(due, drawn, evaders.past))

    def _by_network(self, which):
        """(..., K) of (...,): one for the network, zero for the others."""
        return jax.nn.one_hot(which, self.number)

    def _gradient(self, networks, worlds, part):
        """Of the networks' losses, each from its own worlds alone: some of them at a time, as often
        as the busiest one needs.

        worlds: the networks' numbers of worlds (K,) and all worlds (K, W), each network's own ones
        first; part: see `_loss`.
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
        """() of one network, the sum over worlds of the mean over steps; own (n,) whether a world
        is the network's; part: seen, sample, log_prob, weight, advantage, target, all (n, T,
        ...).
        """
        actor, critic, log_std = networks
        seen, sample, log_prob, weight, advantage, target = part
        weight = own[:, None] * weight
        log_ratio = gaussian_log_prob(sample, outputs(actor, seen)[0], log_std) - log_prob
        # samples of other networks count for nothing, and mustn't overflow
        ratio = jnp.exp(jnp.where(weight > 0.0, log_ratio, 0.0))
        clipped = jnp.clip(ratio, 1.0 - self.how.clip_epsilon, 1.0 + self.how.clip_epsilon)
        surrogate = jnp.minimum(ratio * advantage, clipped * advantage)
        error = (outputs(critic, seen)[1] - target) ** 2
        # weighted too: before the first of its worlds begins, a network's noise stays as it is
        entropy = self.how.entropy_coefficient * gaussian_entropy(log_std)
        return jnp.sum(jnp.mean(weight * (0.5 * error - surrogate - entropy), axis=1))

    def _batch(self, evaders, samples, last, axis):
        """What gradient steps need, minibatch by minibatch: see `_gradient` and `_loss`."""
        how = self.how
        critic = evaders.critic
        value = outputs_of(critic, samples.which, samples.seen)[1]
        last_value = outputs_of(critic, *self.see(evaders.flying, last))[1]
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
        flying = samples.flying[..., None] * self._by_network(samples.which[0])  # (T, E, K)
        scale = 1.0 / jnp.maximum(mean_over_devices(jnp.mean(flying, (0, 1)), axis), 1e-4)
        weight = jnp.sum(scale * flying, axis=-1)

        def mean(x):
            """Of what each sample's network met, (T, E)."""
            by_network = mean_over_devices(jnp.mean(scale * flying * x[..., None], (0, 1)), axis)
            return self._by_network(samples.which[0]) @ by_network

        centred = advantage - mean(advantage)
        normal = centred / (jnp.sqrt(mean(centred**2)) + 1e-8)
        batch = samples.seen, samples.sample, samples.log_prob, weight, normal, advantage + value
        which = minibatches(samples.which[:1], how.minibatches)[..., 0]  # (M, W)
        own = which[:, None] == jnp.arange(self.number)[:, None]
        worlds = jnp.sum(own, axis=-1), jnp.argsort(~own, axis=-1)
        return worlds, minibatches(batch, how.minibatches)

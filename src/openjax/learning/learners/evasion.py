"""Evaders that learn, by PPO (`ppo`), to be caught as late as they can be; a learner of
the training step that also flies the worlds of its evaders.

Payoff is the time to the capture and not whether there is one: where captures are
forced, every evader would be as good as any other. A game names `learned` among its
evaders as often as there are networks; the world of one of them is flown by its
samples, and it learns from these until it is caught. They judge nobody: the evaders of
`openjax.evaluation.judges` have other networks, other seeds and other senses.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int32, PRNGKeyArray

from openjax.learning.advantages import generalised_advantages
from openjax.learning.collectives import mean_over_devices, minibatches
from openjax.learning.learners.learner import Experience
from openjax.learning.learners.ppo import (
    NetworkOutputs,
    Objective,
    Samples,
    for_many,
    gradient_steps,
    normalise,
)
from openjax.learning.settings import EvaderLearningSettings
from openjax.learning.train_state import TrainState, clipped_adam, shuffle
from openjax.policy import PolicyParameters, gaussian_entropy, gaussian_log_prob
from openjax.pursuit import Pursuit, PursuitState
from openjax.pursuit.evaders import init_network, learned_place, scene_of
from openjax.pursuit.evaders.learned import features, outputs, outputs_of
from openjax.pursuit.shapes import Scalar

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

    @property
    def flying(self) -> Any:
        """(K + S, ...) the actors, and the earlier selves."""

        def join(actor, pool):
            return jnp.concatenate([actor, pool[self.past]])

        return jax.tree.map(join, self.actor, self.pool)

    @property
    def networks(self) -> tuple[Any, Any, jax.Array]:
        """The networks that learn."""
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
class EvaderLearner:
    """The learner of a game's learned evaders (`openjax.learning.learners.Learner`)."""

    settings: EvaderLearningSettings
    environment: Pursuit
    updates: int
    """Of the run."""

    @property
    def number(self) -> int:
        """Networks; 0: none learns, as the game names none."""
        learned_number = self.environment.settings.evaders.count("learned")
        return learned_number - self.settings.past if learned_number else 0

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Of each network."""
        settings = self.settings
        steps = self.updates * settings.EPOCHS * settings.MINIBATCHES
        rate = optax.linear_schedule(settings.LEARNING_RATE, settings.LEARNING_RATE_END, steps)
        return for_many(clipped_adam(1.0, rate))

    def start(self, parameters: PolicyParameters, key: PRNGKeyArray) -> LearningEvaders:
        """Fresh evaders: some do as greedy ones, others nothing yet
        (`openjax.pursuit.evaders.init_network`). The pursuers' `parameters` are nothing to
        them.
        """
        numbers = jnp.arange(self.number)
        init = jax.vmap(init_network)
        actor_keys, critic_keys = jax.vmap(lambda key: jax.random.split(key, self.number))(
            jax.random.split(key)
        )
        actor = init(actor_keys, numbers)
        critic = init(critic_keys, numbers)
        log_std = jnp.full((self.number, 3), self.settings.INITIAL_LOG_STD, jnp.float32)
        # the pool begins full, with the fresh actors in turn
        places = jnp.arange(self.settings.POOL) % self.number
        return LearningEvaders(
            actor=actor,
            critic=critic,
            log_std=log_std,
            optimiser=self.optimiser.init((actor, critic, log_std)),
            pool=jax.tree.map(lambda leaf: leaf[places], actor),
            past=jnp.arange(self.settings.past, dtype=jnp.int32) % self.settings.POOL,
            update=jnp.zeros((), jnp.int32),
        )

    def see(
        self, networks: Any, state: PursuitState
    ) -> tuple[Int32[Array, " worlds"], dict[str, Array]]:
        """Of worlds (E, ...) which of the networks acts, (E,), and what it sees."""
        settings = self.environment.settings
        which = learned_place(settings.evaders, state.evader.kind)

        def one(which, state):
            return features(networks, which, scene_of(settings, state), state.evader.memory)

        return which, jax.vmap(one)(which, state)

    def act(
        self, evaders: LearningEvaders, state: PursuitState, noise: Float[Array, "worlds 3"]
    ) -> tuple[Float[Array, "worlds 3"], EvaderSamples]:
        """Desired velocities (E, 3) in worlds (E, ...) as shares of the speed, NaN where
        none of the networks acts, and the samples; noise (E, 3).
        """
        flying = evaders.flying
        which, features = self.see(flying, state)
        mean = outputs_of(flying, which, features)[0]
        # earlier selves tremble as much as the others do on average: how they once did
        # isn't kept
        usual = jnp.mean(evaders.log_std, 0)
        spread = jnp.concatenate(
            [evaders.log_std, jnp.broadcast_to(usual, (self.settings.past, 3))]
        )
        # a row for each world by a product; -1 has no one, and gets zeros
        log_std = jax.nn.one_hot(which, self.number + self.settings.past) @ spread
        sample = mean + jnp.exp(log_std) * noise
        log_prob = jax.vmap(gaussian_log_prob)(sample, mean, log_std)
        samples = EvaderSamples(features, which, sample, log_prob, ~state.statistics.captured)
        desired_velocity = jnp.where((which >= 0)[:, None], sample, jnp.nan)
        # a program of its own: the compiler doesn't fuse the evaders' rules with the
        # physics
        return jax.lax.optimization_barrier(desired_velocity), samples

    def learn(
        self,
        state: LearningEvaders,
        parameters: PolicyParameters,
        experience: Experience,
        key: PRNGKeyArray,
    ) -> tuple[LearningEvaders, PolicyParameters, dict[str, Scalar]]:
        """After all epochs on the samples of a rollout."""
        samples = experience.rollout.learning
        state = self.improve(state, samples, experience.state, key, experience.axis)
        return state, parameters, {"evader_noise": jnp.mean(state.log_std)}

    def improve(
        self,
        evaders: LearningEvaders,
        samples: EvaderSamples,
        last: PursuitState,
        key: PRNGKeyArray,
        axis: str | None = None,
    ) -> LearningEvaders:
        """The evaders after all epochs on samples (T, E, ...), which ended in worlds
        `last` (E, ...).

        `key` shuffles, the same on all devices; `axis` is the name of the devices'
        axis.
        """
        batch = self._batch(evaders, samples, last, axis)

        def gradient(parameters, index):
            worlds, part = jax.tree.map(lambda leaf: leaf[index], batch)
            slope = self._gradient(parameters[0], worlds, part)
            return (mean_over_devices(slope, axis),), {}

        (learnt,), _ = gradient_steps(
            (TrainState(evaders.networks, evaders.optimiser),),
            (self.optimiser,),
            gradient,
            shuffle(key, self.settings.EPOCHS, self.settings.MINIBATCHES),
        )
        actor, critic, log_std = learnt.parameters
        evaders = evaders.replace(
            actor=actor,
            critic=critic,
            log_std=log_std,
            optimiser=learnt.optimiser,
            update=evaders.update + 1,
        )
        if not self.settings.past:
            return evaders
        return self._remember(evaders, jax.random.fold_in(key, 1))

    def _remember(self, evaders, key):
        """Now and then one of the actors takes a place in the pool, and other earlier
        selves fly.
        """
        due = evaders.update % self.settings.POOL_EVERY == 0
        network_key, place_key, past_key = jax.random.split(key, 3)
        network = jax.random.randint(network_key, (), 0, self.number)
        place = jax.random.randint(place_key, (), 0, self.settings.POOL)
        slots = jax.random.randint(past_key, (self.settings.past,), 0, self.settings.POOL)

        def renew(pool, actor):
            return pool.at[place].set(jnp.where(due, actor[network], pool[place]))

        pool = jax.tree.map(renew, evaders.pool, evaders.actor)
        return evaders.replace(pool=pool, past=jnp.where(due, slots, evaders.past))

    def _by_network(self, which):
        """(..., K) of (...,): one for the network, zero for the others."""
        return jax.nn.one_hot(which, self.number)

    def _gradient(self, networks, worlds, part):
        """Of the networks' losses, each from its own worlds alone: some of them at a
        time, as often as the busiest one needs.

        worlds: the networks' numbers of worlds (K,) and all worlds (K, W), each
        network's own ones first; part: see `_loss`.
        """
        number, order = worlds
        total_worlds = order.shape[1]
        # a network meets about as many worlds as one of the game's evaders: so many at
        # a time, and where they aren't a divisor of all, somewhat more
        kinds = len(self.environment.settings.evaders)
        parts = max(n for n in range(1, kinds + 1) if total_worlds % n == 0)
        some = total_worlds // parts

        def add(i, total):
            place = i * some + jnp.arange(some)
            taken_worlds = jax.tree.map(lambda leaf: leaf[order[:, place]], part)
            belongs = place < number[:, None]
            gradient = jax.vmap(jax.grad(self._loss))(networks, belongs, taken_worlds)
            # a mean over all worlds: `weight` makes up for how few of them are a
            # network's
            return jax.tree.map(lambda total, some: total + some / total_worlds, total, gradient)

        rounds = jnp.max(-(-number // some))  # rounded up
        return jax.lax.fori_loop(0, rounds, add, jax.tree.map(jnp.zeros_like, networks))

    def _loss(self, networks, belongs, part):
        """() of one network, the sum over worlds of the mean over steps; belongs (n,)
        whether a world is the network's; part: `Samples` (n, T).
        """
        actor, critic, log_std = networks
        features, sample, weight = part.inputs
        weight = belongs[:, None] * weight
        log_prob = gaussian_log_prob(sample, outputs(actor, features)[0], log_std)
        # samples of other networks count for nothing, and mustn't overflow: zero times
        # infinity is no number
        log_prob = jnp.where(weight > 0.0, log_prob, part.log_prob)

        def mean(values):
            return jnp.sum(jnp.mean(weight * values, axis=1))

        # weighted too: before the first of its worlds begins, a network's noise stays
        # as it is
        bonus = mean(self.settings.ENTROPY_COEFFICIENT * gaussian_entropy(log_std))
        answer = NetworkOutputs(log_prob, outputs(critic, features)[1], bonus)
        objective = Objective(mean, self.settings.CLIP_EPSILON, optax.l2_loss)
        return objective.loss(answer, part)[0]

    def _batch(self, evaders, samples, last, axis):
        """The data of the gradient steps, minibatch by minibatch: see `_gradient` and `_loss`."""
        settings = self.settings
        advantage, value = self._advantages(evaders, samples, last)
        # a world keeps its evader until the rollout's end
        by_network = self._by_network(samples.which[0])  # (E, K)
        flying = samples.flying[..., None] * by_network  # (T, E, K)
        # each network's samples weigh as much in all, however soon its worlds are
        # caught
        scale = 1.0 / jnp.maximum(mean_over_devices(jnp.mean(flying, (0, 1)), axis), 1e-4)

        def mean(x):
            """Of what each sample's network met, (T, E)."""
            means = mean_over_devices(jnp.mean(scale * flying * x[..., None], (0, 1)), axis)
            return by_network @ means

        batch = Samples(
            inputs=(samples.seen, samples.sample, jnp.sum(scale * flying, axis=-1)),
            log_prob=samples.log_prob,
            advantage=normalise(advantage, mean),
            target=advantage + value,
        )
        which = minibatches(samples.which[:1], settings.MINIBATCHES)[..., 0]  # (M, W)
        belongs = which[:, None] == jnp.arange(self.number)[:, None]  # (M, K, W)
        # False comes before True: a network's own worlds first
        worlds = jnp.sum(belongs, axis=-1), jnp.argsort(~belongs, axis=-1)
        return worlds, minibatches(batch, settings.MINIBATCHES)

    def _advantages(self, evaders, samples, last):
        """Of samples (T, E), and the critics' values."""
        value = outputs_of(evaders.critic, samples.which, samples.seen)[1]
        which, features = self.see(evaders.flying, last)
        last_value = outputs_of(evaders.critic, which, features)[1]
        # a capture ends what an evader learns from, though the pursuers' episode goes
        # on
        is_over = jnp.concatenate([~samples.flying[1:], last.statistics.captured[None]])
        advantage = generalised_advantages(
            REWARD * (~is_over).astype(jnp.float32),
            value,
            jnp.concatenate([value[1:], last_value[None]]),
            is_over,
            jnp.zeros_like(is_over),
            self.settings.DISCOUNT,
            self.settings.GAE_LAMBDA,
        )
        return advantage, value

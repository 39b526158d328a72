"""Evaders that learn a best response to a fixed policy, by PPO, several side by side.

An evader decides every `hold` control steps and flies its decision until the next one:
noise that is new in every step of 10 ms averages out before a point has moved two
centimetres. Its reward is the time that it is free, and its foresight is seconds. It
starts from nothing, as no evader of the library does: an evader that starts as a greedy
one stays one.

PPO: Schulman et al., 2017, arXiv 1707.06347; advantages: Schulman et al., 2016, arXiv
1506.02438.
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

from openjax.evaluation.judges.duel import Duel, World, copies
from openjax.evaluation.judges.networks import apply_network, init_network, likeliest, of_way, ways
from openjax.evaluation.judges.senses import sense, to_world
from openjax.evaluation.judges.settings import BestResponseSettings
from openjax.learning.advantages import generalised_advantages
from openjax.learning.learners.ppo import (
    NetworkOutputs,
    Objective,
    Samples,
    for_many,
    gradient_steps,
    normalise,
)
from openjax.learning.train_state import TrainState, clipped_adam, shuffle
from openjax.policy import PolicyParameters
from openjax.pursuit import EpisodeStatistics, PursuitSettings, PursuitState, Task
from openjax.pursuit.rows import where_rows

BEGINNING = 2.0
"""Seconds after which a chase is looked at."""
FIRST = 0.5
"""Share of the speed that each way has at first."""


@struct.dataclass
class Evaders:
    """L learners."""

    actor: dict[str, jax.Array]
    critic: dict[str, jax.Array]
    log_std: jax.Array  # (L, 3)
    world_axes: jax.Array  # (L,) bool
    discount: jax.Array  # (L,), of a decision

    def one(self, place: int) -> tuple[dict[str, jax.Array], jax.Array]:
        """The actor of one learner, without an axis of learners, and () whether it sees
        in the world's axes.
        """
        return jax.tree.map(lambda leaf: leaf[place], (self.actor, self.world_axes))

    def steps_free(
        self, place: int, game: PursuitSettings, hold: int, state: PursuitState
    ) -> jax.Array:
        """() steps that one learner expects to be free from a state of one world, those
        to come counting less.
        """
        critic = jax.tree.map(lambda leaf: leaf[place][None], self.critic)
        senses = sense(game, state, self.world_axes[place])
        share = apply_network(critic, senses[None, None])[0, 0, 0]
        return hold * share / (1.0 - self.discount[place])

    @property
    def networks(self) -> tuple[Any, Any, jax.Array]:
        """The networks that learn."""
        return self.actor, self.critic, self.log_std


@struct.dataclass
class ResponseCarry:
    """Everything that a run is; E worlds of each learner."""

    evaders: Evaders
    optimiser: Any
    world: World  # (L * E, ...), learner by learner
    key: jax.Array


@struct.dataclass
class Decisions:
    """T decisions in L * E worlds."""

    senses: jax.Array  # (T, L * E, F)
    way: jax.Array  # (T, L * E) int, which of the ways was chosen
    sample: jax.Array  # (T, L * E, 3)
    log_prob: jax.Array  # (T, L * E)
    # (T, L * E), share of the decision's steps in which the evader was free
    free: jax.Array
    over: jax.Array  # (T, L * E) bool, caught or out of time at its end
    is_capture: jax.Array  # (T, L * E) bool


@struct.dataclass
class Chase:
    """Numbers that explain an escape, summed over the moments of an episode in which the evader is
    free.
    """

    moments: jax.Array  # () how many
    heights: jax.Array  # () m, the highest pursuer above the lowest
    in_sight: jax.Array  # () whether somebody sees the evader
    nearest: jax.Array  # (3,) m, from the evader to the three nearest pursuers


@dataclass(frozen=True, eq=False)
class BestResponse:
    """The learners against a policy's mean, as pure functions of a `ResponseCarry`."""

    settings: BestResponseSettings
    duel: Duel
    draw_task: Callable[[jax.Array], Task]
    """key -> a task to learn on"""
    draw_own_task: Callable[[jax.Array, jax.Array], Task] | None = None
    """key, () int which learner -> a task for it; None: all learn on the same."""

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Of all learners at once: Adam treats each number by itself, the norm is each
        one's.
        """
        settings = self.settings
        rate = optax.linear_schedule(settings.learning_rate, 0.0, settings.gradient_steps)
        return for_many(clipped_adam(1.0, rate))

    @property
    def game(self) -> PursuitSettings:
        """The game's settings."""
        return self.duel.environment.settings

    def start(self, key: jax.Array) -> ResponseCarry:
        """Evaders that do nothing but tremble, and worlds at their starts."""
        key, actor_key, critic_key, world_key = jax.random.split(key, 4)
        learners = self.settings.learners
        world = self._fresh(world_key)
        one = jax.tree.map(lambda leaf: leaf[0], world[1])
        inputs = sense(self.game, one, jnp.bool_(False)).size
        log_std = jnp.full((learners, 3), self.settings.initial_log_std, jnp.float32)
        settings = self.settings
        widths = [settings.width_of(learner) for learner in range(learners)]
        number = settings.ways
        actor = init_network(actor_key, widths, (inputs, 4 * number))
        # at first one way in each direction, and all as likely
        bias = np.concatenate([spread(number).ravel(), np.zeros(number)])
        actor["bias_2"] = actor["bias_2"] + jnp.asarray(bias, jnp.float32)
        evaders = Evaders(
            actor=actor,
            critic=init_network(critic_key, widths, (inputs, 1)),
            log_std=log_std,
            world_axes=jnp.array([settings.sees_in_world(place) for place in range(learners)]),
            discount=jnp.asarray(self.settings.discounts(self.game.time_step), jnp.float32),
        )
        return ResponseCarry(evaders, self.optimiser.init(evaders.networks), world, key)

    def step(
        self, parameters: PolicyParameters, carry: ResponseCarry
    ) -> tuple[ResponseCarry, dict[str, jax.Array]]:
        """One rollout and one update; metrics (L,): share of the time free, episodes
        that ended, share of them that ended with a capture.
        """
        key, noise_key, world_key, order_key = jax.random.split(carry.key, 4)
        keys = jax.random.split(noise_key, self.settings.rollout_length)
        decide = functools.partial(self._decide, parameters, carry.evaders, self._fresh(world_key))
        world, decisions = jax.lax.scan(decide, carry.world, keys)
        evaders, optimiser = self._learn(carry, decisions, world[1], order_key)
        episodes = jnp.sum(self._by_learner(decisions.over), (0, 2))
        metrics = {
            "free": jnp.mean(self._by_learner(decisions.free), (0, 2)),
            "episodes": episodes,
            "capture_rate": jnp.sum(self._by_learner(decisions.is_capture), (0, 2))
            / jnp.maximum(episodes, 1),
        }
        return ResponseCarry(evaders, optimiser, world, key), metrics

    def _by_learner(self, values):
        """(T, L, E, ...) of (T, L * E, ...)."""
        learners = self.settings.learners
        return values.reshape(values.shape[0], learners, -1, *values.shape[2:])

    def _fresh(self, key):
        """All worlds at the start of an episode."""
        task_key, reset_key = jax.random.split(key)
        learners = jnp.repeat(jnp.arange(self.settings.learners), self.settings.num_envs)
        keys = jax.random.split(task_key, learners.size)
        if self.draw_own_task is None:
            tasks = jax.vmap(self.draw_task)(keys)
        else:
            tasks = jax.vmap(self.draw_own_task)(keys, learners)
        return self.duel.start(tasks, reset_key)

    def _decide(self, parameters, evaders, fresh, world, key):
        """Worlds after a decision, and the decision.

        A world whose evader is caught goes on at once, at the start that `fresh` has
        for it: where it is caught twice in a rollout, at the same one again.
        """
        hold = self.settings.hold
        senses = _sense(self.game, evaders, world[1])
        way_key, noise_key = jax.random.split(key)
        means, odds = ways(apply_network(evaders.actor, senses))
        way = jax.random.categorical(way_key, odds)
        mean = of_way(means, way)
        log_std = evaders.log_std[:, None]
        sample = mean + jnp.exp(log_std) * jax.random.normal(noise_key, mean.shape)
        velocity = _in_world(evaders, sample, world[1])
        world = self.duel.fly(parameters, world, velocity, hold)
        state = world[1]
        is_capture = state.statistics.captured
        # of a decision in which it was caught, the steps before that
        late = jnp.maximum(state.step - state.statistics.capture_step + 1, 0) / hold
        over = is_capture | (state.step >= self.game.episode_length)
        decision = Decisions(
            senses=senses.reshape(over.size, -1),
            way=way.ravel(),
            sample=sample.reshape(over.size, 3),
            log_prob=_log_prob(way, sample, means, odds, log_std).ravel(),
            free=jnp.where(is_capture, 1.0 - jnp.minimum(late, 1.0), 1.0),
            over=over,
            is_capture=is_capture,
        )

        return where_rows(over, fresh, world), decision

    def _learn(self, carry, decisions, state, key):
        """The evaders and their optimiser after all epochs."""
        settings = self.settings
        evaders = carry.evaders
        samples = self._samples(evaders, decisions, state)

        def gradient(parameters, place):
            part = jax.tree.map(lambda leaf: leaf[:, place], samples)
            return (jax.grad(self._loss)(parameters[0], part),), {}

        order = shuffle(key, settings.epochs, samples.log_prob.shape[1])
        (learnt,), _ = gradient_steps(
            (TrainState(evaders.networks, carry.optimiser),),
            (self.optimiser,),
            gradient,
            order.reshape(settings.epochs * settings.minibatches, -1),
        )
        actor, critic, log_std = learnt.parameters
        log_std = jnp.maximum(log_std, settings.least_log_std)
        return evaders.replace(actor=actor, critic=critic, log_std=log_std), learnt.optimiser

    def _samples(self, evaders, decisions, state):
        """(L, T * E, ...) what is learnt from."""
        settings = self.settings
        senses = self._by_learner(decisions.senses)  # (T, L, E, F)
        of_steps = jax.vmap(lambda senses: apply_network(evaders.critic, senses)[..., 0])
        value = of_steps(senses)  # (T, L, E)
        last = apply_network(evaders.critic, _sense(self.game, evaders, state))[..., 0]
        discount = evaders.discount[:, None]
        over = self._by_learner(decisions.over)
        advantage = generalised_advantages(
            # values are shares of the time to come: at most one
            (1.0 - discount) * self._by_learner(decisions.free),
            value,
            jnp.concatenate([value[1:], last[None]]),
            over,
            jnp.zeros_like(over),
            discount,
            settings.gae_lambda,
        )
        samples = Samples(
            inputs=(senses, self._by_learner(decisions.way), self._by_learner(decisions.sample)),
            log_prob=self._by_learner(decisions.log_prob),
            # of each learner
            advantage=normalise(advantage, lambda x: jnp.mean(x, (0, 2), keepdims=True)),
            target=advantage + value,
        )

        def flat(leaf):
            by_learner = jnp.moveaxis(leaf, 0, 1)
            return by_learner.reshape(by_learner.shape[0], -1, *by_learner.shape[3:])

        return jax.tree.map(flat, samples)

    def _loss(self, networks, part):
        """(), the sum over learners: none's gradient knows of another."""
        settings = self.settings
        actor, critic, log_std = networks
        senses, way, sample = part.inputs
        means, odds = ways(apply_network(actor, senses))
        spread_out = jnp.sum(log_std, -1) - jnp.mean(jnp.sum(jnp.exp(odds) * odds, -1), axis=1)
        answer = NetworkOutputs(
            log_prob=_log_prob(way, sample, means, odds, log_std[:, None]),
            value=apply_network(critic, senses)[..., 0],
            bonus=settings.entropy_coefficient * spread_out,
        )
        # a value is at most one, an advantage of one standard deviation some hundredths
        objective = Objective(
            lambda x: jnp.mean(x, axis=1),
            settings.clip_epsilon,
            optax.squared_error,
            settings.value_coefficient,
        )
        return jnp.sum(objective.loss(answer, part)[0])


def fly_learners(
    duel: Duel, hold: int, evaders: Evaders, parameters: PolicyParameters, start: World
) -> tuple[EpisodeStatistics, Chase]:
    """Statistics and what the chases are like (L, B): an episode of each learner,
    without noise, from each of B starts.
    """
    game = duel.environment.settings
    learners = evaders.world_axes.size

    def one(carry, _):
        world, chase = carry
        decision = likeliest(apply_network(evaders.actor, _sense(game, evaders, world[1])))
        velocity = _in_world(evaders, decision, world[1])
        world = duel.fly(parameters, world, velocity, hold)
        look = jax.vmap(functools.partial(look_at, game))
        return (world, jax.tree.map(jnp.add, chase, look(world[1]))), None

    world = copies(start, learners)
    chase = jax.vmap(functools.partial(look_at, game))(world[1])
    carry = world, jax.tree.map(jnp.zeros_like, chase)
    world, chase = jax.lax.scan(one, carry, length=game.episode_length // hold)[0]

    def by_learner(leaf):
        return leaf.reshape(learners, -1, *leaf.shape[1:])

    return jax.tree.map(by_learner, (world[1].statistics, chase))


def look_at(game: PursuitSettings, state: PursuitState) -> Chase:
    """One moment of one world, all zeros where the evader is caught already or the
    chase has hardly begun.
    """
    counts = ~state.statistics.captured & (state.step * game.time_step >= BEGINNING)
    position = state.drones.position
    active = jnp.ones(len(position), bool) if state.active is None else state.active
    height = position[:, 2]
    highest = jnp.max(jnp.where(active, height, -jnp.inf))
    distance = jnp.linalg.norm(position - state.evader_position, axis=-1)
    distance = jnp.sort(jnp.where(active, distance, game.arena_radius * 2))
    moment = Chase(
        moments=jnp.ones(()),
        heights=highest - jnp.min(jnp.where(active, height, jnp.inf)),
        in_sight=state.seen.astype(jnp.float32),
        nearest=jnp.pad(distance, (0, 3))[:3],
    )
    return jax.tree.map(lambda leaf: jnp.where(counts, leaf, 0.0), moment)


def _axes(evaders, state):
    """(L * B,) whether the evader of each world (L * B, ...) sees in the world's
    axes.
    """
    learners = evaders.world_axes.size
    return jnp.repeat(evaders.world_axes, state.step.size // learners)


def _sense(game, evaders, state):
    """(L, B, F) what each learner's evaders sense in worlds (L * B, ...)."""
    senses = jax.vmap(functools.partial(sense, game))(state, _axes(evaders, state))
    return senses.reshape(evaders.world_axes.size, -1, senses.shape[-1])


def _in_world(evaders, decision, state):
    """(L * B, 3) decisions (L, B, 3) in the axes of worlds (L * B, ...)."""
    return jax.vmap(to_world)(decision.reshape(-1, 3), state, _axes(evaders, state))


def spread(number: int) -> np.ndarray:
    """(number, 3) ahead, back, to both sides, up, down, and so on, shares of the speed;
    a single one stands still.
    """
    if number == 1:
        return np.zeros((1, 3))
    axes = np.concatenate([sign * np.eye(3) for sign in (1, -1)])[[0, 3, 1, 4, 2, 5]]
    return FIRST * axes[np.arange(number) % len(axes)]


def _log_prob(way, sample, means, odds, log_std):
    score = (sample - of_way(means, way)) * jnp.exp(-log_std)
    normal = jnp.sum(-0.5 * score**2 - log_std - 0.5 * np.log(2 * np.pi), axis=-1)
    return normal + jnp.take_along_axis(odds, way[..., None], axis=-1)[..., 0]

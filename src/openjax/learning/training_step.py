"""The compiled training step: rollout, predictor update, policy update, selection of tasks; one
function of one carry.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from openjax.baselines import make_policy
from openjax.learning.archive import TaskArchive, empty_archive
from openjax.learning.collectives import gather_over_devices, mean_over_devices, own_keys
from openjax.learning.evader_learning import EvaderLearning, LearningEvaders
from openjax.learning.generator import generate_task, select, successes, task_like
from openjax.learning.mappo import ValueScale, initial_value_scale, make_optimiser, update_policy
from openjax.learning.predictor_update import make_predictor_optimiser, update_predictor
from openjax.learning.rollout import Rollout, collect
from openjax.learning.settings import TrainSettings
from openjax.learning.train_state import Optimisers, TrainState
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitState
from openjax.pursuit.evaders import learned_place
from openjax.vehicle.family import narrowed_bounds


@struct.dataclass
class TrainCarry:
    """Everything that a run is. Saved whole, it goes on as if nothing had happened."""

    actor: TrainState
    critic: TrainState
    predictor: TrainState
    value_scale: ValueScale
    observation: Observation  # (E, ...)
    state: PursuitState  # (E, ...)
    evaders: LearningEvaders | None
    """Those that learn; None where none does."""
    archive: TaskArchive
    key: jax.Array
    update: jax.Array  # () int32, training steps done

    @property
    def policy(self) -> PolicyParameters:
        """The parameters that act."""
        return PolicyParameters(
            actor=self.actor.parameters,
            critic=self.critic.parameters,
            predictor=self.predictor.parameters,
        )

    def with_policy(self, policy: PolicyParameters) -> "TrainCarry":
        """The carry with other parameters, its optimisers as they are."""
        return self.replace(
            actor=self.actor.replace(parameters=policy.actor),
            critic=self.critic.replace(parameters=policy.critic),
            predictor=self.predictor.replace(parameters=policy.predictor),
        )


@dataclass(frozen=True)
class Building:
    """What a training step is made of: environment, networks and optimisers of a run's settings."""

    environment: Pursuit
    policy: Policy
    optimisers: Optimisers
    evaders: EvaderLearning


def build(settings: TrainSettings, environment: Pursuit | None = None) -> Building:
    """Environment, networks and optimisers of a run. `environment` overrides the nominal one
    (effects, vehicle).
    """
    environment = environment or Pursuit(settings.environment)
    return Building(
        environment=environment,
        evaders=EvaderLearning(settings.evader_learning, environment, settings.total_updates),
        policy=make_policy(environment, settings.network, settings.predictor),
        optimisers=Optimisers(
            *make_optimiser(settings.mappo, settings.total_updates),
            predictor=make_predictor_optimiser(settings.predictor, settings.total_updates),
        ),
    )


def make_start(
    settings: TrainSettings, environment: Pursuit | None = None
) -> Callable[[jax.Array], TrainCarry]:
    """The start of a run, key -> carry, by `jax.jit`: fresh networks, uniform tasks, an empty
    archive, staggered starts.

    `jax.eval_shape` of it tells the carry's shapes; it is traced once for both.
    """
    parts = build(settings, environment)
    return jax.jit(functools.partial(initial_carry, settings, parts))


def initial_carry(settings: TrainSettings, parts: Building, key: jax.Array) -> TrainCarry:
    """The carry of a run's start; `parts` are what `build` gives."""
    environment = _starting(settings, parts.environment, 0.0)
    archive = empty_archive(task_like(settings.environment), settings.generator.capacity)
    key, policy_key, task_key, reset_key = jax.random.split(key, 4)
    tasks = _tasks(
        settings,
        archive,
        jax.random.split(task_key, settings.num_envs // settings.episodes_per_task),
    )
    tasks = settings.schedule.first(tasks, settings.num_envs)
    observation, state = jax.vmap(environment.reset_to)(
        jax.random.split(reset_key, settings.num_envs), tasks
    )
    state = state.replace(step=settings.schedule.age(settings.num_envs) * settings.rollout_length)
    observation = jax.vmap(environment.observe)(state)
    policy = parts.policy.init(policy_key, jax.tree.map(lambda x: x[0], observation))
    return TrainCarry(
        **parts.optimisers.start(policy),
        value_scale=initial_value_scale(),
        observation=observation,
        state=state,
        evaders=parts.evaders.start(jax.random.fold_in(policy_key, 1))
        if parts.evaders.number
        else None,
        archive=archive,
        key=key,
        update=jnp.zeros((), jnp.int32),
    )


@struct.dataclass
class Flown:
    """What a training step learns from: a rollout, and what it needs of before and after it."""

    rollout: Rollout  # (T, E, ...)
    frames: jax.Array  # (E, H, F), the history before
    predicted: jax.Array | None  # (E, K, 3) m, predicted after it


@dataclass(frozen=True)
class Phases:
    """The training step in parts, one after the other.

    Metrics are () by name, counted over the rollout or over the episodes that ended with it.
    """

    fly: Callable[[TrainCarry], tuple[TrainCarry, Flown, dict[str, jax.Array]]]
    """carry -> carry after a rollout, what is learnt from it, metrics"""
    learn: tuple[Callable[[TrainCarry, Flown], tuple[TrainCarry, dict[str, jax.Array]]], ...]
    """(carry, flown) -> carry after an update, metrics; one for each network that learns on its
    own
    """
    renew: Callable[[TrainCarry], tuple[TrainCarry, dict[str, jax.Array]]]
    """carry -> carry whose worlds have new tasks where their episodes have just ended, metrics of
    these episodes
    """

    def __call__(self, carry: TrainCarry) -> tuple[TrainCarry, dict[str, jax.Array]]:
        """The whole step; its operations bear the parts' names, by which a profile tells them
        apart.
        """
        carry, flown, metrics = _named(self.fly)(carry)
        for learn in self.learn:
            carry, watched = _named(learn)(carry, flown)
            metrics |= watched
        carry, counted = _named(self.renew)(carry)
        return carry, metrics | counted


def _named(phase):
    return jax.named_scope(phase.__name__)(phase)


def make_phases(
    settings: TrainSettings, environment: Pursuit | None = None, axis: str | None = None
) -> Phases:
    """The parts of the training step; `axis` names the axis of devices when they run under
    `shard_map`.
    """
    step = _Step(settings, build(settings, environment), axis)
    learn = (step.learn_predictor,) if settings.predictor.enabled else ()
    learn += (step.learn_evaders,) if step.parts.evaders.number else ()
    return Phases(step.fly, (*learn, step.learn_policy), step.renew)


def make_training_step(
    settings: TrainSettings, environment: Pursuit | None = None, axis: str | None = None
) -> Callable[[TrainCarry], tuple[TrainCarry, dict[str, jax.Array]]]:
    """The training step `carry -> (carry, metrics)` as one function; compile it with `jax.jit(step,
    donate_argnums=0)`.

    `axis` names the axis of devices when it runs under `shard_map` (see `openjax.cluster.devices`).
    """
    phases = make_phases(settings, environment, axis)
    # a function by its name, as the compiler's cache knows programs by theirs
    return lambda carry: phases(carry)


@dataclass(frozen=True)
class _Step:
    """What the phases have in common."""

    settings: TrainSettings
    parts: Building
    axis: str | None

    def fly(self, carry):
        settings = self.settings
        axis = self.axis
        environment = self.parts.environment
        policy = self.parts.policy
        shape = (settings.rollout_length, settings.environment.num_pursuers, policy.sample_size)
        keys = own_keys(self._key(carry, 1), carry.state.step.shape[0], axis)
        noise = jax.vmap(lambda k: jax.random.normal(k, shape))(keys)
        world = (carry.observation, carry.state)
        share = penalty_share_at(settings, self._progress(carry))
        learning = None
        if carry.evaders is not None:
            draws = jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(k, 1), (shape[0], 3)))(
                keys
            )
            learning = self.parts.evaders, carry.evaders, jnp.moveaxis(draws, 1, 0)
        rollout, observation, state = collect(
            environment, policy, carry.policy, *world, jnp.moveaxis(noise, 1, 0), share, learning
        )
        flown = Flown(rollout, carry.state.frames, policy.predict(carry.policy, observation))
        metrics = {"reward": mean_over_devices(jnp.mean(rollout.reward), axis)}
        return carry.replace(observation=observation, state=state), flown, metrics

    def learn_predictor(self, carry, flown):
        rollout = flown.rollout
        axis = self.axis
        keys = own_keys(self._key(carry, 2), flown.frames.shape[0], axis)
        how = self.parts.policy, self.parts.optimisers.predictor, self.parts.environment.settings
        predictor, loss = update_predictor(*how, carry.predictor, flown.frames, rollout, keys, axis)
        error = jnp.linalg.norm(rollout.predicted[:, :, 0] - rollout.evader, axis=-1)
        metrics = {
            "predictor_loss": loss,
            "prediction_error": mean_over_devices(jnp.mean(error), axis),
        }
        return carry.replace(predictor=predictor), metrics

    def learn_policy(self, carry, flown):
        before = (carry.actor, carry.critic, carry.value_scale)
        last = (carry.observation, flown.predicted)
        how = self.settings.mappo, self.parts.policy, self.parts.optimisers
        actor, critic, scale, metrics = update_policy(
            *how,
            *before,
            flown.rollout,
            *last,
            self._key(carry, 3),
            self.axis,
            self._progress(carry),
        )
        return carry.replace(actor=actor, critic=critic, value_scale=scale), metrics

    def learn_evaders(self, carry, flown):
        key = jax.random.fold_in(self._key(carry, 3), 1)
        evaders = self.parts.evaders.learn(
            carry.evaders, flown.rollout.learning, carry.state, key, self.axis
        )
        return carry.replace(evaders=evaders), {"evader_noise": jnp.mean(evaders.log_std)}

    def renew(self, carry):
        settings = self.settings
        schedule = self.settings.schedule
        axis = self.axis
        progress = self._progress(carry)
        starting = _starting(settings, self.parts.environment, progress)
        group = schedule.ending(carry.update)
        ended = schedule.members(carry.state, group)
        archive, metrics = _selection(
            settings, carry.archive, ended, penalty_share_at(settings, progress), axis
        )
        # new worlds for those that end, and for those that are started anew within the episodes of
        # other groups
        numbers = ended.step.shape[0], schedule.restarts(carry.state.step.shape[0])
        keys = self._key(carry, 4), self._key(carry, 5)
        fresh = _fresh(settings, starting, archive, *keys, numbers, axis)
        worlds = schedule.renewed((carry.observation, carry.state), fresh, group)
        carry = carry.replace(
            observation=worlds[0],
            state=worlds[1],
            archive=archive,
            key=self._key(carry, 0),
            update=carry.update + 1,
        )
        return carry, metrics

    def _key(self, carry, number):
        """One of the keys of this step: of the next step, noise, windows, shuffling, tasks,
        resets.
        """
        return jax.random.split(carry.key, 6)[number]

    def _progress(self, carry):
        """() share of the run that is done."""
        return carry.update.astype(jnp.float32) / self.settings.total_updates


def penalty_share_at(settings, progress):
    """Share of the penalties that counts when a share `progress` of the run is done: a ramp from
    its start to one.
    """
    start = settings.mappo.penalty_start
    return start + (1.0 - start) * jnp.minimum(
        progress / max(settings.mappo.penalty_ramp, 1e-6), 1.0
    )


def _starting(settings, environment, progress):
    """The environment whose episodes start with the vehicles and evaders of that moment of the
    run.
    """

    def grown(start, ramp):
        return jnp.clip((progress - start) / max(ramp, 1e-6), 0.0, 1.0)

    family = settings.environment.vehicles
    if family and (settings.vehicles_start or settings.vehicles_ramp):
        share = grown(settings.vehicles_start, settings.vehicles_ramp)
        environment = environment.with_bounds(narrowed_bounds(family, share))
    if settings.evaders_start or settings.evaders_ramp:
        share = grown(settings.evaders_start, settings.evaders_ramp)
        environment = environment.with_evader_share(share)
    return environment


def _tasks(settings, archive, keys, close=None):
    """One task per key, repeated for the environments that share it; shares `close` of pursuers
    start close to something.
    """
    draw = functools.partial(generate_task, settings.generator, settings.environment, archive)
    tasks = jax.vmap(draw)(keys, close if settings.restart_close else None)
    return jax.tree.map(lambda x: jnp.repeat(x, settings.episodes_per_task, axis=0), tasks)


def _fresh(settings, environment, archive, task_key, reset_key, numbers, axis):
    """Observations and states of worlds of this device at the start of newly drawn tasks, of both
    `numbers` in one.

    Of the second ones some pursuers start close to something. All are drawn at once, by a program
    half as large.
    """
    share = settings.episodes_per_task
    close = jnp.repeat(jnp.array([0.0, settings.restart_close]), np.array(numbers) // share)

    def keys(key, numbers):
        parts = (
            own_keys(jax.random.fold_in(key, i), number, axis)
            for i, number in enumerate(numbers)
            if number
        )
        return jnp.concatenate(list(parts))

    tasks = _tasks(
        settings, archive, keys(task_key, [number // share for number in numbers]), close
    )
    return jax.vmap(environment.reset_to)(keys(reset_key, numbers), tasks)


def _selection(settings, archive, ended, penalty_share, axis):
    """Put unsolved tasks of ended episodes into the archive; and what these episodes were like."""
    statistics = ended.statistics
    complete = statistics.steps >= settings.environment.episode_length
    share = settings.episodes_per_task
    solved = (
        successes(settings.generator, statistics, penalty_share)
        .astype(jnp.float32)
        .reshape(-1, share)
    )
    if settings.generator.enabled:
        tasks = jax.tree.map(lambda x: x[::share], ended.task)
        candidates = gather_over_devices((tasks, jnp.mean(solved, axis=1), complete[::share]), axis)
        archive = select(settings.generator, archive, *candidates)
    counted = {
        "capture_rate": statistics.captured,
        "capture_step": statistics.capture_step,
        "collision_rate": statistics.collision_rate,
        "crash_rate": statistics.crashed,
        "over_speed_rate": statistics.over_speed_rate,
        "episode_return": statistics.episode_return,
        "success_rate": solved.ravel(),
    }
    if "learned" in settings.environment.evaders:
        by_network = learned_place(settings.environment.evaders, ended.evader.kind) >= 0
        counted |= {"learned": by_network, "learned_capture_rate": by_network & statistics.captured}
    lasting = settings.schedule.lasting(statistics.steps.shape[0])
    counted = {
        name: jnp.mean(value.astype(jnp.float32)[lasting]) for name, value in counted.items()
    }
    counted = mean_over_devices(counted, axis)
    if "learned" in counted:
        counted["learned_capture_rate"] /= jnp.maximum(counted["learned"], 1e-6)
    return archive, counted | {"archive_size": archive.size.astype(jnp.float32)}

"""The compiled training step: rollout, predictor update, policy update, selection of tasks; one function of one carry."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from openjax.baselines import make_policy
from openjax.learning.archive import TaskArchive, empty_archive
from openjax.learning.collectives import gather_over_devices, mean_over_devices, own_keys
from openjax.learning.generator import generate_task, select, successes
from openjax.learning.mappo import ValueScale, initial_value_scale, make_optimiser, update_policy
from openjax.learning.predictor_update import make_predictor_optimiser, update_predictor
from openjax.learning.rollout import Rollout, collect
from openjax.learning.settings import TrainSettings
from openjax.learning.train_state import Optimisers, TrainState
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitState, empty_task
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
    archive: TaskArchive
    key: jax.Array
    update: jax.Array  # () int32, training steps done

    @property
    def policy(self) -> PolicyParameters:
        """The parameters that act."""
        return PolicyParameters(
            actor=self.actor.parameters, critic=self.critic.parameters, predictor=self.predictor.parameters
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


def build(settings: TrainSettings, environment: Pursuit | None = None) -> Building:
    """Environment, networks and optimisers of a run. `environment` overrides the nominal one (effects, vehicle)."""
    environment = environment or Pursuit(settings.environment)
    return Building(
        environment=environment,
        policy=make_policy(environment, settings.network, settings.predictor),
        optimisers=Optimisers(
            *make_optimiser(settings.mappo, settings.total_updates),
            predictor=make_predictor_optimiser(settings.predictor, settings.total_updates),
        ),
    )


def make_start(
    settings: TrainSettings, environment: Pursuit | None = None
) -> Callable[[jax.Array], TrainCarry]:
    """The start of a run, key -> carry, by `jax.jit`: fresh networks, uniform tasks, an empty archive, staggered starts.

    `jax.eval_shape` of it tells the carry's shapes; it is traced once for both.
    """
    parts = build(settings, environment)
    return jax.jit(functools.partial(initial_carry, settings, parts))


def init_carry(settings: TrainSettings, key: jax.Array, environment: Pursuit | None = None) -> TrainCarry:
    """The carry at the start of a run; see `make_start`."""
    return make_start(settings, environment)(key)


def abstract_carry(settings: TrainSettings, environment: Pursuit | None = None) -> TrainCarry:
    """Shapes and dtypes of a run's carry, without computing one."""
    return jax.eval_shape(make_start(settings, environment), jax.random.key(0))


def initial_carry(settings: TrainSettings, parts: Building, key: jax.Array) -> TrainCarry:
    """The carry of a run's start; `parts` are what `build` gives."""
    environment = _starting(settings, parts.environment, 0.0)
    archive = empty_archive(empty_task(settings.environment), settings.generator.capacity)
    key, policy_key, task_key, reset_key = jax.random.split(key, 4)
    tasks = _tasks(
        settings, archive, jax.random.split(task_key, settings.num_envs // settings.episodes_per_task)
    )
    tasks = settings.schedule.first(tasks, settings.num_envs)
    observation, state = jax.vmap(environment.reset_to)(jax.random.split(reset_key, settings.num_envs), tasks)
    state = state.replace(step=settings.schedule.age(settings.num_envs) * settings.rollout_length)
    observation = jax.vmap(environment.observe)(state)
    policy = parts.policy.init(policy_key, jax.tree.map(lambda x: x[0], observation))
    return TrainCarry(
        **parts.optimisers.start(policy),
        value_scale=initial_value_scale(),
        observation=observation,
        state=state,
        archive=archive,
        key=key,
        update=jnp.zeros((), jnp.int32),
    )


def learn_predictor(
    parts: Building, carry: TrainCarry, rollout: Rollout, keys: jax.Array, axis: str | None = None
) -> tuple[TrainState, jax.Array]:
    """The carry's predictor after an update on a rollout, and its () loss; `keys` (E,) draw the windows."""
    game, optimiser = parts.environment.settings, parts.optimisers.predictor
    return update_predictor(
        parts.policy, optimiser, game, carry.predictor, carry.state.frames, rollout, keys, axis
    )


def learn_policy(
    settings: TrainSettings,
    parts: Building,
    carry: TrainCarry,
    rollout: Rollout,
    last: tuple[Observation, jax.Array | None],
    key: jax.Array,
    axis: str | None = None,
    progress: jax.Array | float = 0.0,
) -> tuple[TrainState, TrainState, ValueScale, dict[str, jax.Array]]:
    """Actor, critic and value scale of the carry after an update on a rollout, and () metrics; see `update_policy`.

    `last` is the (E, ...) observation after the rollout and its (E, K, 3) prediction; `key` shuffles, `progress` () is the
    share of the run that is done.
    """
    return update_policy(
        settings.mappo,
        parts.policy,
        parts.optimisers,
        carry.actor,
        carry.critic,
        carry.value_scale,
        rollout,
        *last,
        key,
        axis,
        progress,
    )


def make_training_step(
    settings: TrainSettings, environment: Pursuit | None = None, axis: str | None = None
) -> Callable[[TrainCarry], tuple[TrainCarry, dict[str, jax.Array]]]:
    """The training step `carry -> (carry, metrics)`; compile it with `jax.jit(step, donate_argnums=0)`.

    `axis` names the axis of devices when it runs under `shard_map` (see `openjax.cluster.devices`).
    Metrics are () float32, counted over the rollout or over the episodes that ended with it.
    """
    parts = build(settings, environment)
    environment, policy, schedule = parts.environment, parts.policy, settings.schedule

    def training_step(carry: TrainCarry) -> tuple[TrainCarry, dict[str, jax.Array]]:
        key, noise_key, window_key, shuffle_key, task_key, reset_key = jax.random.split(carry.key, 6)
        num_envs = carry.state.step.shape[0]  # of this device

        # rollout
        progress = carry.update.astype(jnp.float32) / settings.total_updates
        penalty_share = penalty_share_at(settings, progress)
        starting = _starting(settings, environment, progress)
        shape = (settings.rollout_length, settings.environment.num_pursuers, policy.sample_size)
        noise = jax.vmap(lambda k: jax.random.normal(k, shape))(own_keys(noise_key, num_envs, axis))
        rollout, observation, state = collect(
            environment,
            policy,
            carry.policy,
            carry.observation,
            carry.state,
            jnp.moveaxis(noise, 1, 0),
            penalty_share,
        )
        last_predicted = policy.predict(carry.policy, observation)

        # predictor update
        predictor, metrics = carry.predictor, {}
        if settings.predictor.enabled:
            predictor, loss = learn_predictor(
                parts, carry, rollout, own_keys(window_key, num_envs, axis), axis
            )
            error = jnp.linalg.norm(rollout.predicted[:, :, 0] - rollout.evader, axis=-1)
            metrics |= {"predictor_loss": loss, "prediction_error": mean_over_devices(jnp.mean(error), axis)}

        # policy update
        actor, critic, scale, watched = learn_policy(
            settings, parts, carry, rollout, (observation, last_predicted), shuffle_key, axis, progress
        )
        metrics |= watched

        # selection of tasks: the one start group whose episodes have just ended gets new ones
        group = schedule.ending(carry.update)
        ended = schedule.members(state, group)
        archive, counted = _selection(settings, carry.archive, ended, penalty_share, axis)
        metrics |= counted
        fresh = _fresh(settings, starting, archive, task_key, reset_key, ended.step.shape[0], axis)
        worlds = schedule.with_members((observation, state), fresh, group)
        if number := schedule.restarts(num_envs):
            # and so do the worlds that are started anew within the episodes of other groups
            keys = (jax.random.fold_in(task_key, 1), jax.random.fold_in(reset_key, 1))
            fresh = _fresh(settings, starting, archive, *keys, number, axis, settings.restart_close)
            worlds = schedule.with_restarts(worlds, fresh, group)
        observation, state = worlds

        carry = TrainCarry(
            actor=actor,
            critic=critic,
            predictor=predictor,
            value_scale=scale,
            observation=observation,
            state=state,
            archive=archive,
            key=key,
            update=carry.update + 1,
        )
        metrics["reward"] = mean_over_devices(jnp.mean(rollout.reward), axis)
        return carry, {name: value.astype(jnp.float32) for name, value in metrics.items()}

    return training_step


def penalty_share_at(settings, progress):
    """Share of the penalties that counts when a share `progress` of the run is done: a ramp from its start to one."""
    start = settings.mappo.penalty_start
    return start + (1.0 - start) * jnp.minimum(progress / max(settings.mappo.penalty_ramp, 1e-6), 1.0)


def _starting(settings, environment, progress):
    """The environment whose episodes start with the vehicles and evaders of that moment of the run."""

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


def _tasks(settings, archive, keys, close=0.0):
    """One task per key, repeated for the environments that share it; a share of pursuers starts close to something."""

    draw = functools.partial(generate_task, settings.generator, settings.environment, archive, close=close)
    return jax.tree.map(lambda x: jnp.repeat(x, settings.episodes_per_task, axis=0), jax.vmap(draw)(keys))


def _fresh(settings, environment, archive, task_key, reset_key, number, axis, close=0.0):
    """Observations and states of `number` worlds of this device at the start of newly drawn tasks."""
    tasks = _tasks(settings, archive, own_keys(task_key, number // settings.episodes_per_task, axis), close)
    return jax.vmap(environment.reset_to)(own_keys(reset_key, number, axis), tasks)


def _selection(settings, archive, ended, penalty_share, axis):
    """Put unsolved tasks of ended episodes into the archive; and what these episodes were like."""
    statistics = ended.statistics
    complete = statistics.steps >= settings.environment.episode_length
    share = settings.episodes_per_task
    solved = successes(settings.generator, statistics, penalty_share).astype(jnp.float32).reshape(-1, share)
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
    lasting = settings.schedule.lasting(statistics.steps.shape[0])
    counted = {name: jnp.mean(value.astype(jnp.float32)[lasting]) for name, value in counted.items()}
    counted = mean_over_devices(counted, axis)
    return archive, counted | {"archive_size": archive.size}

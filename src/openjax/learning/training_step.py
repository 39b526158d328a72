"""The compiled training step: rollout, predictor update, policy update, selection of
tasks; one function of one carry.
"""

import functools
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import PRNGKeyArray

import openjax.baselines  # noqa: F401  registers its policies
from openjax.learning.archive import TaskArchive, empty_archive
from openjax.learning.collectives import gather_over_devices, mean_over_devices, own_keys
from openjax.learning.generator import generate_task, select, successes, task_like
from openjax.learning.learners.evasion import EvaderLearner
from openjax.learning.learners.learner import Experience, Learner, check_learners, check_learning
from openjax.learning.learners.mappo import Mappo
from openjax.learning.learners.predictor_update import PredictorLearner
from openjax.learning.rollout import ExplorationNoise, Players, collect
from openjax.learning.settings import TrainSettings
from openjax.policy import Network, OwnPolicy, Policy, PolicyParameters, check_network, make_policy
from openjax.pursuit import Observation, Pursuit, PursuitState
from openjax.pursuit.evaders import learned_place
from openjax.pursuit.shapes import Scalar
from openjax.pursuit.teams import team_mean
from openjax.vehicle.family import narrowed_bounds

# the order stays: it says which key is which, and a seed's first updates are compared to
# the bit
KEYS = ("next step", "noise", "windows", "shuffling", "tasks", "resets")


@struct.dataclass
class TrainCarry:
    """Everything that a run is. Saved whole, it goes on as if nothing had happened."""

    policy: PolicyParameters
    """The parameters that act."""
    learners: dict[str, Any]
    """The state of each learner, by name."""
    observation: Observation  # (E, ...)
    state: PursuitState  # (E, ...)
    archive: TaskArchive
    key: jax.Array
    update: jax.Array  # () int32, training steps done


@dataclass(frozen=True)
class Parts:
    """The parts of a training step. Each may be your own."""

    environment: Pursuit
    policy: Policy
    """Whatever has `init`, `predict`, `distribution`, `action`, `value` and `evaluate`;
    see `openjax.policy.Policy`.
    """
    learners: Mapping[str, Learner]
    """By name, in the order in which they learn."""


def build(
    settings: TrainSettings,
    environment: Pursuit | None = None,
    policy: Policy | Network | None = None,
    learners: Mapping[str, Learner] | None = None,
) -> Parts:
    """The parts of a run; those that aren't given are the ones that the settings name.

    A `policy` may be a network alone (`openjax.policy.Network`). Own `learners` stand
    beside the shipped ones, or in the place of the one whose name they have:
    `predictor`, `evaders`, `policy` (which is MAPPO).

    Raises:
      UserError: a network or learner that isn't one.
    """
    environment = environment or Pursuit(settings.environment)
    policy = policy or make_policy(environment, settings.network, settings.predictor)
    if isinstance(policy, type) or not hasattr(policy, "evaluate"):
        check_network(policy, jax.eval_shape(environment.reset, jax.random.key(0))[0])
        policy = OwnPolicy(policy)
    check_learners(learners or {})
    shipped_parts = shipped_learners(settings, environment, policy)
    return Parts(environment, policy, {**shipped_parts, **(learners or {})})


def shipped_learners(
    settings: TrainSettings, environment: Pursuit, policy: Policy | OwnPolicy
) -> dict[str, Learner]:
    """The learners that a run's settings name, in the order in which they learn."""
    # the order is free: all learn from the predictions with which the rollout was flown
    learners = {}
    updates = settings.total_updates
    if policy.predictor.enabled:
        learners["predictor"] = PredictorLearner(policy, environment.settings, updates)
    evaders = EvaderLearner(settings.evader_learning, environment, updates)
    if evaders.number:
        learners["evaders"] = evaders
    return {**learners, "policy": Mappo(settings.mappo, policy, updates)}


def make_start(
    settings: TrainSettings, parts: Parts | None = None
) -> Callable[[jax.Array], TrainCarry]:
    """The start of a run, key -> carry, by `jax.jit`: fresh networks, uniform tasks, an
    empty archive, staggered starts.

    `jax.eval_shape` of it tells the carry's shapes; it is traced once for both.
    """
    return jax.jit(functools.partial(initial_carry, settings, parts or build(settings)))


def initial_carry(settings: TrainSettings, parts: Parts, key: PRNGKeyArray) -> TrainCarry:
    """The carry of a run's start; `parts` are what `build` gives."""
    # vehicles and evaders as at the beginning of their curricula
    environment = _starting(settings, parts.environment, 0.0)
    archive = empty_archive(task_like(parts.environment.settings), settings.generator.capacity)
    key, policy_key, task_key, reset_key = jax.random.split(key, 4)
    tasks = _tasks(
        settings,
        environment,
        archive,
        jax.random.split(task_key, settings.num_envs // settings.episodes_per_task),
    )
    tasks = settings.schedule.first(tasks, settings.num_envs)
    observation, state = jax.vmap(environment.reset_to)(
        jax.random.split(reset_key, settings.num_envs), tasks
    )
    # staggered: the groups begin in the middle of an episode, so that from the first
    # update on one of them ends its episodes with each rollout
    state = state.replace(step=settings.schedule.age(settings.num_envs) * settings.rollout_length)
    observation = jax.vmap(environment.observe)(state)
    policy = parts.policy.init(policy_key, jax.tree.map(lambda x: x[0], observation))
    learners = {
        name: learner.start(policy, _start_key(name, policy_key))
        for name, learner in parts.learners.items()
    }
    return TrainCarry(
        policy=policy,
        learners=learners,
        observation=observation,
        state=state,
        archive=archive,
        key=key,
        update=jnp.zeros((), jnp.int32),
    )


def _number_of(name):
    """A number for a learner of one's own, by which its keys differ from those of
    others.
    """
    return zlib.crc32(name.encode())


def _start_key(name, policy_key):
    # 1 as ever for the shipped evaders, so that a seed's runs stay what they were
    return jax.random.fold_in(policy_key, 1 if name == "evaders" else _number_of(name))


@dataclass(frozen=True)
class Phases:
    """The training step in parts, one after the other.

    Metrics are () by name, counted over the rollout or over the episodes that ended
    with it.
    """

    fly: Callable[[TrainCarry], tuple[TrainCarry, Experience, dict[str, jax.Array]]]
    """carry -> carry after a rollout, what is learnt from it, metrics"""
    learn: tuple[Callable[[TrainCarry, Experience], tuple[TrainCarry, dict[str, jax.Array]]], ...]
    """(carry, flown) -> carry after an update, metrics; one for each learner"""
    renew: Callable[[TrainCarry], tuple[TrainCarry, dict[str, jax.Array]]]
    """carry -> carry whose worlds have new tasks where their episodes have just ended,
    metrics of these episodes
    """

    def __call__(self, carry: TrainCarry) -> tuple[TrainCarry, dict[str, Scalar]]:
        """The whole step; its operations bear the parts' names, by which a profile
        tells them apart.
        """
        carry, metrics = self.fly_and_learn(carry)
        carry, counts = self.begin_episodes(carry)
        return carry, metrics | counts

    def fly_and_learn(self, carry: TrainCarry) -> tuple[TrainCarry, dict[str, Scalar]]:
        """The step without its last part."""
        carry, experience, metrics = _under_its_name(self.fly)(carry)
        for learn in self.learn:
            carry, measures = _under_its_name(learn)(carry, experience)
            metrics |= measures
        return carry, metrics

    def begin_episodes(self, carry: TrainCarry) -> tuple[TrainCarry, dict[str, Scalar]]:
        """The step's last part, `renew`."""
        return _under_its_name(self.renew)(carry)


def _under_its_name(phase):
    return jax.named_scope(phase.__name__)(phase)


def make_phases(
    settings: TrainSettings, parts: Parts | None = None, axis: str | None = None
) -> Phases:
    """The parts of the training step; `axis` names the axis of devices when they run
    under `shard_map`.
    """
    step = _Step(settings, parts or build(settings), axis)
    learn = tuple(step.learning(name) for name in step.parts.learners)
    return Phases(step.fly, learn, step.renew)


def make_training_step(
    settings: TrainSettings, parts: Parts | None = None
) -> Callable[[TrainCarry], tuple[TrainCarry, dict[str, jax.Array]]]:
    """The training step `carry -> (carry, metrics)` as one function; compile it with
    `jax.jit(step, donate_argnums=0)`.

    Args:
      settings: of the run.
      parts: environment, policy and learners; None: those that the settings name.
    """
    phases = make_phases(settings, parts)
    # a function by its name, as the compiler's cache knows programs by theirs
    return lambda carry: phases(carry)


@dataclass(frozen=True)
class _Step:
    """The common ground of the phases."""

    settings: TrainSettings
    parts: Parts
    axis: str | None

    def fly(self, carry):
        settings = self.settings
        axis = self.axis
        policy = self.parts.policy
        steps = settings.rollout_length
        pursuers = self.parts.environment.settings.num_pursuers
        shape = (steps, pursuers, policy.sample_size)
        keys = own_keys(self._key(carry, "noise"), carry.state.step.shape[0], axis)
        # a key for each world: the same noise on however many devices the worlds lie
        noise = jax.vmap(lambda k: jax.random.normal(k, shape))(keys)
        noise = ExplorationNoise(jnp.moveaxis(noise, 1, 0))
        act = self._evaders(carry)
        hold = settings.evader_learning.HOLD
        if act is not None:
            decisions = (steps // hold, 3)
            draws = jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(k, 1), decisions))(keys)
            noise = noise.replace(evaders=jnp.moveaxis(draws, 1, 0))
        players = Players(self.parts.environment, policy, carry.policy, act, hold)
        world = (carry.observation, carry.state)
        progress = self._progress(carry)
        share = penalty_share_at(settings, progress)
        rollout, observation, state = collect(players, world, noise, share)
        # a rollout keeps the newest frame of each step only: windows begin in the
        # history before it
        experience = Experience(
            rollout=rollout,
            frames=carry.state.frames,
            observation=observation,
            state=state,
            predicted=policy.predict(carry.policy, observation),
            progress=progress,
            axis=axis,
        )
        reward = team_mean(rollout.observation.active, rollout.reward)
        metrics = {"reward": mean_over_devices(reward, axis)}
        return carry.replace(observation=observation, state=state), experience, metrics

    def _evaders(self, carry):
        """The function by which learning evaders fly, (worlds, noise) -> desired velocities,
        samples; None if none learns.
        """
        for name, learner in self.parts.learners.items():
            if hasattr(learner, "act"):
                return functools.partial(learner.act, carry.learners[name])
        return None

    def learning(self, name):
        """The phase in which the learner of that name learns."""
        learner = self.parts.learners[name]

        def learn(carry, experience):
            key = self._learner_key(carry, name)
            old_state = carry.learners[name]
            result = learner.learn(old_state, carry.policy, experience, key)
            check_learning(name, result, old_state)
            state, policy, metrics = result
            return carry.replace(policy=policy, learners={**carry.learners, name: state}), metrics

        learn.__name__ = f"learn_{name}"
        return learn

    def renew(self, carry):
        settings = self.settings
        schedule = self.settings.schedule
        axis = self.axis
        progress = self._progress(carry)
        # the episodes that begin now fly as this moment of the run asks for, those
        # under way as they began
        starting = _starting(settings, self.parts.environment, progress)
        # one group of worlds ends its episodes with each rollout: tasks are judged by
        # whole episodes, and no rollout has a reset in its middle
        group = schedule.ending(carry.update)
        members = schedule.members(carry.state, group)
        archive, metrics = _selection(
            settings, carry.archive, members, penalty_share_at(settings, progress), axis
        )
        # new worlds for those that end, and for those that are started anew within the
        # episodes of other groups
        numbers = members.step.shape[0], schedule.restarts(carry.state.step.shape[0])
        keys = self._key(carry, "tasks"), self._key(carry, "resets")
        fresh = self._fresh(starting, archive, keys, numbers)
        observation, state = schedule.renew((carry.observation, carry.state), fresh, group)
        carry = carry.replace(
            observation=observation,
            state=state,
            archive=archive,
            key=self._key(carry, "next step"),
            update=carry.update + 1,
        )
        return carry, metrics

    def _fresh(self, environment, archive, keys, numbers):
        """Observations and states of this device's worlds at the start of newly drawn
        tasks, of both `numbers` in one; `keys` of tasks and resets.

        Of the second ones some pursuers start close to something. All are drawn at
        once, by a program half as large.
        """
        settings = self.settings
        share = settings.episodes_per_task
        task_numbers = [number // share for number in numbers]
        close = jnp.repeat(jnp.array([0.0, settings.restart_close]), np.array(task_numbers))
        task_key, reset_key = keys

        def of_worlds(key, numbers):
            parts = (
                own_keys(jax.random.fold_in(key, i), number, self.axis)
                for i, number in enumerate(numbers)
                if number
            )
            return jnp.concatenate(list(parts))

        tasks = _tasks(settings, environment, archive, of_worlds(task_key, task_numbers), close)
        return jax.vmap(environment.reset_to)(of_worlds(reset_key, numbers), tasks)

    def _key(self, carry, name):
        """One of the keys of this step, by its name in `KEYS`."""
        return jax.random.split(carry.key, len(KEYS))[KEYS.index(name)]

    def _learner_key(self, carry, name):
        """The key of a learner in this step; shipped ones have the windows' and the
        shuffling's.
        """
        if name == "predictor":
            return self._key(carry, "windows")
        key = self._key(carry, "shuffling")
        if name == "policy":
            return key
        return jax.random.fold_in(key, 1 if name == "evaders" else _number_of(name))

    def _progress(self, carry):
        """() share of the run that is done."""
        return carry.update.astype(jnp.float32) / self.settings.total_updates


def penalty_share_at(settings, progress):
    """Share of the penalties that counts when a share `progress` of the run is done: a
    ramp from its start to one.
    """
    start = settings.mappo.penalty_start
    return start + (1.0 - start) * jnp.minimum(
        progress / max(settings.mappo.penalty_ramp, 1e-6), 1.0
    )


def _starting(settings, environment, progress):
    """The environment whose episodes start with the vehicles and evaders of that moment
    of the run.
    """

    def grow(start, ramp):
        return jnp.clip((progress - start) / max(ramp, 1e-6), 0.0, 1.0)

    family = environment.settings.vehicles
    if family and (settings.vehicles_start or settings.vehicles_ramp):
        share = grow(settings.vehicles_start, settings.vehicles_ramp)
        environment = environment.with_bounds(narrowed_bounds(family, share))
    if settings.evaders_start or settings.evaders_ramp:
        share = grow(settings.evaders_start, settings.evaders_ramp)
        environment = environment.with_evader_share(share)
    return environment


def _tasks(settings, environment, archive, keys, close=None):
    """One task per key, repeated for the environments that share it; shares `close` of
    pursuers start close to something.
    """
    draw = functools.partial(generate_task, settings.generator, environment.settings, archive)
    tasks = jax.vmap(draw)(keys, close if settings.restart_close else None)
    return jax.tree.map(lambda x: jnp.repeat(x, settings.episodes_per_task, axis=0), tasks)


def _selection(settings, archive, members, penalty_share, axis):
    """Put unsolved tasks of ended episodes into the archive; and what these episodes
    were like.
    """
    statistics = members.statistics
    complete = statistics.steps >= settings.environment.episode_length
    share = settings.episodes_per_task
    is_solved = successes(settings.generator, statistics, penalty_share)
    # neighbours fly the same task: a row for each task
    is_solved = is_solved.astype(jnp.float32).reshape(-1, share)
    if settings.generator.enabled:
        # of neighbours that flew one task the first stands for all
        tasks = jax.tree.map(lambda x: x[::share], members.task)
        # the archive is the same on all devices, and so all of them see all candidates
        tasks, success, complete = gather_over_devices(
            (tasks, jnp.mean(is_solved, axis=1), complete[::share]), axis
        )
        archive = select(settings.generator, archive, tasks, success, complete)
    metrics = {
        "capture_rate": statistics.captured,
        "capture_step": statistics.capture_step,
        "collision_rate": statistics.collision_rate,
        "crash_rate": statistics.crashed,
        "over_speed_rate": statistics.over_speed_rate,
        "episode_return": statistics.episode_return,
        "success_rate": is_solved.ravel(),
    }
    if "learned" in settings.environment.evaders:
        by_network = learned_place(settings.environment.evaders, members.evader.kind) >= 0
        metrics |= {"learned": by_network, "learned_capture_rate": by_network & statistics.captured}
    # worlds that were started anew within their episode flew a shorter one, which is no
    # fair sample
    lasting = settings.schedule.lasting(statistics.steps.shape[0])
    metrics = {
        name: jnp.mean(value.astype(jnp.float32)[lasting]) for name, value in metrics.items()
    }
    metrics = mean_over_devices(metrics, axis)
    if "learned" in metrics:
        # shares of all episodes so far: one by the other is the rate among the learned
        # ones'
        metrics["learned_capture_rate"] /= jnp.maximum(metrics["learned"], 1e-6)
    return archive, metrics | {"archive_size": archive.size.astype(jnp.float32)}

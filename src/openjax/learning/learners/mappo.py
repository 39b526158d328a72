"""Multi-agent PPO (Yu et al., 2022): shared actor, clipped ratio, normalised values."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import PRNGKeyArray

from openjax.learning.advantages import generalised_advantages
from openjax.learning.collectives import joint_moments, minibatches
from openjax.learning.learners.learner import Experience
from openjax.learning.learners.ppo import (
    NetworkOutputs,
    Objective,
    Samples,
    gradient_steps,
    normalise,
)
from openjax.learning.settings import MappoSettings
from openjax.learning.train_state import TrainState, clipped_adam, shuffle
from openjax.policy import OwnPolicy, Policy, PolicyParameters, gaussian_entropy, gaussian_log_prob
from openjax.pursuit.shapes import Scalar
from openjax.pursuit.teams import team_mean


@struct.dataclass
class ValueScale:
    """Running mean and mean square of the returns, for value normalisation."""

    mean: jax.Array  # ()
    square: jax.Array  # ()
    weight: jax.Array  # () sum of weights so far, to remove the bias of the start

    @property
    def moments(self) -> tuple[Scalar, Scalar]:
        """Mean () and standard deviation () of the returns; 0 and 1 before the first
        update.
        """
        weight = jnp.maximum(self.weight, 1e-6)
        mean = self.mean / weight
        # a weighted sum of what was seen, over the sum of its weights, as Adam does
        variance = self.square / weight - mean**2
        std = jnp.where(self.weight > 0, jnp.sqrt(jnp.maximum(variance, 1e-4)), 1.0)
        return mean, std


def initial_value_scale() -> ValueScale:
    """No returns seen."""
    zero = jnp.zeros((), jnp.float32)
    return ValueScale(mean=zero, square=zero, weight=zero)


WATCHED = ("policy_loss", "value_loss", "kl", "clipped", "entropy", "actor_gradient")
"""Of gradient steps."""

LEAST_SCALE = 1e-4
"""Of a step, as a share of the schedule's: the first one, and none is smaller."""


class StepScale(NamedTuple):
    """State of `follow_kl`."""

    scale: jax.Array  # () of the last step, as a share of the schedule's


def follow_kl(target: float) -> optax.GradientTransformationExtraArgs:
    """Scale steps so that the policy's divergence from the one that flew stays near
    `target` (nats).

    Its `update` takes `kl` (), that divergence before the step: above twice the target
    the step is divided by 1.5, below half of it multiplied, never past the schedule's
    (the adaptive rule of Schulman et al., 2017, section 4, on the step size as in Rudin
    et al., 2022). From a policy whose noise is small, a step of fixed size leads far
    outside the ratio's clip range, where the clipped loss has no gradient that would
    lead back.
    """

    def init(parameters):
        return StepScale(jnp.full((), LEAST_SCALE, jnp.float32))

    def update(change, state, parameters=None, *, kl, **others):
        # an actor that doesn't learn yet says nothing about the size of its steps
        grows = (kl < target / 2) & jnp.any(change != 0.0)
        # a divergence that isn't finite is too large, too
        factor = jnp.where(kl <= 2 * target, jnp.where(grows, 1.5, 1.0), 1 / 1.5)
        scale = jnp.clip(state.scale * factor, LEAST_SCALE, 1.0)
        return scale * change, StepScale(scale)

    return optax.GradientTransformationExtraArgs(init, update)


def make_optimiser(
    settings: MappoSettings, total_updates: int
) -> tuple[optax.GradientTransformationExtraArgs, optax.GradientTransformationExtraArgs]:
    """Optimisers of actor and critic; the step size falls linearly to zero over the
    run, the actor's may start late.

    With a `target_kl` the actor's update takes `kl`; see `follow_kl`.
    """
    steps = total_updates * settings.EPOCHS * settings.minibatches
    schedule = optax.linear_schedule(settings.learning_rate, 0.0, steps)

    def late(count):
        return jnp.where(count < settings.actor_start * steps, 0.0, schedule(count))

    max_norm = settings.MAX_GRAD_NORM
    # the critic isn't held back: with `actor_start` it is what learns first
    actor_rate = late if settings.actor_start else schedule
    # behind Adam, which would scale a scaled gradient up again
    scaling = follow_kl(settings.target_kl) if settings.target_kl else None
    return clipped_adam(max_norm, actor_rate, scaling), clipped_adam(max_norm, schedule)


def loss(
    settings: MappoSettings,
    policy: Policy | OwnPolicy,
    parameters: tuple[Any, Any],
    samples: Samples,
    clip: jax.Array | float,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Sum of actor's and critic's () loss, `parameters` (actor, critic); and what to
    watch.

    The ratio is clipped to 1 +- `clip` (); the values' loss is the Huber loss of
    normalised ones. Unless actor and critic share an encoder, neither's gradient knows
    of the other. Means are those of pursuers that are there.
    """
    observation, predicted, action = samples.inputs
    actor, critic = parameters
    mean, log_std, value = policy.evaluate(actor, critic, observation, predicted)
    log_prob = gaussian_log_prob(action, mean, log_std)
    entropy = gaussian_entropy(log_std)
    answer = NetworkOutputs(log_prob, value, settings.entropy_coefficient * entropy)
    objective = Objective(
        mean=functools.partial(team_mean, observation.active),
        clip=clip,
        value_error=functools.partial(optax.huber_loss, delta=settings.HUBER),
        value_coefficient=settings.VALUE_COEFFICIENT,
    )
    total, terms = objective.loss(answer, samples)
    return total, objective.watch(terms) | {"entropy": entropy}


class Estimates(NamedTuple):
    """The critic's values of a rollout of T steps in E worlds."""

    advantage: jax.Array  # (T, E, N)
    returns: jax.Array  # (T, E, N)
    explained_variance: jax.Array  # (), of the returns by the values


@struct.dataclass
class MappoState:
    """The state of MAPPO between two updates, beside the policy's parameters."""

    actor: Any
    """State of the actor's optimiser."""
    critic: Any
    """State of the critic's."""
    value_scale: ValueScale


@dataclass(frozen=True)
class Mappo:
    """Multi-agent PPO as a learner (`openjax.learning.learners.Learner`) of actor and
    critic.
    """

    settings: MappoSettings
    policy: Policy
    """Whatever has `distribution`, `value` and `evaluate`."""
    total_updates: int
    """Of the run: learning rates fall over it."""

    @functools.cached_property
    def optimisers(self) -> tuple[optax.GradientTransformationExtraArgs, ...]:
        """The actor's and the critic's."""
        return make_optimiser(self.settings, self.total_updates)

    def start(self, parameters: PolicyParameters, key: PRNGKeyArray) -> MappoState:
        """Before the first update: no steps taken, no returns seen."""
        actor, critic = self.optimisers
        return MappoState(
            actor.init(parameters.actor), critic.init(parameters.critic), initial_value_scale()
        )

    def learn(
        self,
        state: MappoState,
        parameters: PolicyParameters,
        experience: Experience,
        key: PRNGKeyArray,
    ) -> tuple[MappoState, PolicyParameters, dict[str, Scalar]]:
        """All epochs of the policy update on one rollout; `key` shuffles."""
        estimates = self._estimates(state.value_scale, parameters, experience)
        scale = self._new_scale(state.value_scale, estimates.returns, experience)
        mean, std = scale.moments
        # by the moments with these returns in them: values and targets are then of one
        # scale
        targets = (estimates.returns - mean) / std
        samples = self._samples(estimates.advantage, targets, experience)
        actor = TrainState(parameters.actor, state.actor)
        critic = TrainState(parameters.critic, state.critic)
        (actor, critic), metrics = self._epochs((actor, critic), samples, experience, key)
        parameters = parameters.replace(actor=actor.parameters, critic=critic.parameters)
        metrics["explained_variance"] = estimates.explained_variance
        metrics["value_scale"] = std
        return MappoState(actor.optimiser, critic.optimiser, scale), parameters, metrics

    def _estimates(self, scale, parameters, experience):
        """Advantages and returns of a rollout, by the critic as it was."""
        settings = self.settings
        rollout = experience.rollout
        mean, std = scale.moments
        # the history's frames are the predictor's; the policy sees the prediction
        inputs = rollout.observation.replace(frames=None), rollout.predicted
        last_inputs = experience.observation.replace(frames=None), experience.predicted
        # before and after all steps by one program: one for what comes last would be as
        # large
        observation, prediction = jax.tree.map(
            lambda x, last: jnp.concatenate([x, last[None]]), inputs, last_inputs
        )
        values = self.policy.value(parameters.actor, parameters.critic, observation, prediction)
        values = mean + std * values
        value = values[:-1]
        next_values = values[1:]
        per_pursuer = value.shape
        is_terminal = jnp.broadcast_to(rollout.terminated[..., None], per_pursuer)
        active = observation.active
        if active is not None:
            # for who falls out nothing comes after
            is_terminal |= active[:-1] & ~active[1:]
        advantage = generalised_advantages(
            settings.REWARD_SCALE * rollout.reward,
            value,
            next_values,
            is_terminal,
            jnp.broadcast_to(rollout.truncated[..., None], per_pursuer),
            settings.discount,
            settings.gae_lambda,
        )
        returns = advantage + value
        # an advantage is what the value left of the return: one less the share that is
        # unexplained
        active = rollout.observation.active
        _, spread_left = joint_moments(advantage, experience.axis, active)
        _, spread = joint_moments(returns, experience.axis, active)
        explained_share = 1.0 - spread_left**2 / (spread**2 + 1e-8)
        return Estimates(advantage, returns, explained_share)

    def _new_scale(self, scale, returns, experience):
        """The running moments after these returns."""
        decay = self.settings.VALUE_NORM_DECAY
        active = experience.rollout.observation.active
        mean, square = experience.mean((team_mean(active, returns), team_mean(active, returns**2)))
        return ValueScale(
            mean=decay * scale.mean + (1 - decay) * mean,
            square=decay * scale.square + (1 - decay) * square,
            weight=decay * scale.weight + (1 - decay),
        )

    def _samples(self, advantage, targets, experience):
        """The rollout's samples with advantages and targets (T, E, N), minibatch by
        minibatch, (M, W, T, ...).
        """
        rollout = experience.rollout
        active = rollout.observation.active
        samples = Samples(
            inputs=(rollout.observation.replace(frames=None), rollout.predicted, rollout.action),
            log_prob=rollout.log_prob,
            # over the whole rollout, not in each minibatch, whose moments are noisier
            advantage=normalise(advantage, lambda x: experience.mean(team_mean(active, x))),
            target=targets,
        )
        return minibatches(samples, self.settings.minibatches)

    def _epochs(self, networks, samples, experience, key):
        """Actor and critic with their optimisers' states after all gradient steps, and
        the means of what was watched.
        """
        settings = self.settings
        change = settings.clip_epsilon_end - settings.clip_epsilon
        clip = settings.clip_epsilon + change * experience.progress
        # each network as one vector while it learns: leaf by leaf, a step on a GPU is
        # forty kernels more
        actor, critic = networks
        actor_vector, to_actor = ravel_pytree(actor.parameters)
        critic_vector, to_critic = ravel_pytree(critic.parameters)

        def gradient(vectors, step):
            index, first = step
            part = jax.tree.map(
                lambda x: every_nth(x[index], first, settings.step_subsampling), samples
            )

            def part_loss(actor, critic):
                parameters = (to_actor(actor), to_critic(critic))
                return loss(settings, self.policy, parameters, part, clip)

            actor, critic = vectors
            gradients = jax.grad(part_loss, argnums=(0, 1), has_aux=True)(actor, critic)
            # gradients and what is watched over all devices by one collective
            gradients, watch = experience.mean(gradients)
            return gradients, watch | {"actor_gradient": jnp.linalg.norm(gradients[0])}

        vectors = (actor.replace(parameters=actor_vector), critic.replace(parameters=critic_vector))
        (actor, critic), metrics = gradient_steps(
            vectors, self.optimisers, gradient, self._order(key), WATCHED
        )
        actor = actor.replace(parameters=to_actor(actor.parameters))
        critic = critic.replace(parameters=to_critic(critic.parameters))
        return (actor, critic), metrics

    def _order(self, key):
        """The minibatches of all gradient steps, and the first of the trajectory's
        steps that each sees; None: it sees all.
        """
        settings = self.settings
        order = shuffle(key, settings.EPOCHS, settings.minibatches)
        if settings.step_subsampling == 1:
            return order, None
        draw = jax.random.fold_in(key, 1)
        return order, jax.random.randint(draw, order.shape, 0, settings.step_subsampling)


def every_nth(x, first, number):
    """(E, T, ...) to (E, T / number, ...): every `number`-th step from `first` on."""
    if number == 1:
        return x
    x = x.reshape(x.shape[0], -1, number, *x.shape[2:])
    return jax.lax.dynamic_index_in_dim(x, first, axis=2, keepdims=False)

"""Supervised training of the evader predictor on the rollout (the paper's section
IV-B1).
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int32, PRNGKeyArray

from openjax.learning.collectives import own_keys
from openjax.learning.learners.learner import Experience
from openjax.learning.rollout import Rollout
from openjax.learning.train_state import TrainState
from openjax.policy import Policy, PolicyParameters, PredictorSettings
from openjax.pursuit import PursuitSettings
from openjax.pursuit.shapes import Scalar


def make_predictor_optimiser(
    settings: PredictorSettings, total_updates: int
) -> optax.GradientTransformation:
    """Adam, with gradients cut at norm 1."""
    steps = total_updates * settings.steps
    step_size = optax.linear_schedule(settings.LEARNING_RATE, 0.0, steps)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(step_size))


def windows_and_labels(
    policy: Policy,
    history_spacing: int,
    earlier: Float[Array, "worlds span frame"],
    rollout: Rollout,
    times: Int32[Array, "worlds windows"],
) -> tuple[
    Float[Array, "worlds windows length frame"],
    Float[Array, "worlds windows 3"],
    Float[Array, "worlds windows horizons 3"],
]:
    """Windows of frames that end at the given steps, and the true positions to be
    predicted.

    Episodes start and end between rollouts only and the history is cleared at a reset,
    so no window and no label crosses the boundary of an episode.

    Args:
      policy: for the predictor's horizons.
      history_spacing: steps between two frames of a window.
      earlier: (E, H, F) frames before the rollout's second step, oldest first (H =
        window's span); its last one is the rollout's first.
      rollout: T steps.
      times: (E, W) steps of the rollout, at most T - largest horizon.

    Returns:
      frames (E, W, n, F), last_seen (E, W, 3), positions (E, W, K, 3).
    """
    span = earlier.shape[1]
    new = jnp.swapaxes(rollout.observation.frames[1:, :, 0], 0, 1)
    # index span - 1 + t is the frame of step t
    sequence = jnp.concatenate([earlier, new], axis=1)
    window = jnp.arange(history_spacing - 1, span, history_spacing)
    frames = _take(sequence, times[..., None] + window)
    last_seen = _take(jnp.swapaxes(rollout.observation.last_seen, 0, 1), times)
    # evader[t] is the position after step t, that is one step ahead of the observation
    # of step t
    ahead = jnp.array(policy.predictor.horizons) - 1
    positions = _take(jnp.swapaxes(rollout.evader, 0, 1), times[..., None] + ahead)
    return frames, last_seen, positions


def prediction_loss(
    settings: PredictorSettings,
    game: PursuitSettings,
    predictions: Float[Array, "*windows horizons 3"],
    last_seen: Float[Array, "*windows 3"],
    positions: Float[Array, "*windows horizons 3"],
) -> Scalar:
    """() loss of predictions (..., K, 3), given last_seen (..., 3) and the true
    positions (..., K, 3).

    Squared errors are nearly all those of the longest horizon, and of windows that end
    before the evader was first seen: nothing can be learnt from these, but what is
    learnt from them is carried over to where it is lost from sight.
    """
    error = predictions - positions
    # in units of the distance that the evader flies within each horizon, all horizons
    # weigh alike
    is_flown = game.evader_speed * game.time_step * jnp.array(settings.horizons, jnp.float32)
    # the arena's middle stands for an evader that nobody has seen yet
    was_seen = jnp.any(last_seen != jnp.array(game.middle, jnp.float32), axis=-1)
    return jnp.mean(was_seen[..., None, None] * (error / is_flown[:, None]) ** 2)


@dataclass(frozen=True)
class PredictorLearner:
    """The evader predictor as a learner (`openjax.learning.learners.Learner`): a few
    gradient steps on random windows of each world.
    """

    policy: Policy
    """For the predictor's network and settings."""
    game: PursuitSettings
    total_updates: int
    """Of the run: the learning rate may fall over it."""

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """See `make_predictor_optimiser`."""
        return make_predictor_optimiser(self.policy.predictor, self.total_updates)

    def start(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Any:
        """The optimiser's state."""
        return self.optimiser.init(parameters.predictor)

    def learn(
        self, state: Any, parameters: PolicyParameters, experience: Experience, key: PRNGKeyArray
    ) -> tuple[Any, PolicyParameters, dict[str, Scalar]]:
        """After the gradient steps on one rollout; `key` draws the windows."""
        rollout = experience.rollout
        data = self._windows(experience, key)

        def loss(parameters, frames, last_seen, positions):
            predictions = self.policy.predict_from(parameters, frames, last_seen)
            return prediction_loss(
                self.policy.predictor, self.game, predictions, last_seen, positions
            )

        def gradient_step(predictor, batch):
            frames, last_seen, positions = batch
            value, gradient = jax.value_and_grad(loss)(
                predictor.parameters, frames, last_seen, positions
            )
            value, gradient = experience.mean((value, gradient))
            return predictor.update(self.optimiser, gradient), value

        predictor = TrainState(parameters.predictor, state)
        predictor, values = jax.lax.scan(gradient_step, predictor, data)
        # of the nearest horizon, which is one step where the settings name it first
        error = jnp.linalg.norm(rollout.predicted[:, :, 0] - rollout.evader, axis=-1)
        metrics = {
            "predictor_loss": jnp.mean(values),
            "prediction_error": experience.mean(jnp.mean(error)),
        }
        parameters = parameters.replace(predictor=predictor.parameters)
        return predictor.optimiser, parameters, metrics

    def _windows(self, experience, key):
        """Windows of frames, last seen and true positions, (steps, E, windows / steps,
        ...): every gradient step sees other windows of every world.
        """
        settings = self.policy.predictor
        rollout = experience.rollout
        keys = own_keys(key, experience.frames.shape[0], experience.axis)
        # later windows would have labels beyond the rollout
        room = rollout.reward.shape[0] - settings.horizons[-1] + 1
        times = jax.vmap(lambda key: jax.random.permutation(key, room)[: settings.windows])(keys)
        data = windows_and_labels(
            self.policy, self.game.history_spacing, experience.frames, rollout, times
        )

        def by_step(x):
            """(E, W, ...) -> (steps, E, W / steps, ...)."""
            parts = x.reshape(x.shape[0], settings.steps, -1, *x.shape[2:])
            return jnp.moveaxis(parts, 1, 0)

        return jax.tree.map(by_step, data)


def _take(values: jax.Array, index: jax.Array) -> jax.Array:
    """values (E, T, ...) at index (E, ...) along the second axis, per environment."""
    return jax.vmap(lambda v, i: v[i])(values, index)

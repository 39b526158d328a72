"""Supervised training of the evader predictor on the rollout (the paper's section IV-B1)."""

import jax
import jax.numpy as jnp
import optax

from openjax.learning.devices import mean_over_devices
from openjax.learning.rollout import Rollout
from openjax.policy import Policy, PredictorSettings


def make_predictor_optimiser(settings: PredictorSettings, total_updates: int) -> optax.GradientTransformation:
    """Adam, with gradients cut at norm 1."""
    step_size = settings.learning_rate
    if settings.decay:
        step_size = optax.linear_schedule(step_size, 0.0, total_updates * settings.steps)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(step_size))


def windows_and_labels(
    policy: Policy, history_spacing: int, earlier: jax.Array, rollout: Rollout, times: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Windows of frames that end at the given steps, and the true positions to be predicted.

    Episodes start and end between rollouts only and the history is cleared at a reset, so no window and no label
    crosses the boundary of an episode.

    Args:
        policy: for the predictor's horizons.
        history_spacing: steps between two frames of a window.
        earlier: (E, H, F) frames before the rollout's second step, oldest first (H = window's span); its last one
            is the rollout's first.
        rollout: T steps.
        times: (E, W) steps of the rollout, at most T - largest horizon.

    Returns:
        frames (E, W, n, F), last_seen (E, W, 3), positions (E, W, K, 3).
    """
    span = earlier.shape[1]
    new = jnp.swapaxes(rollout.observation.frames[1:, :, 0], 0, 1)
    sequence = jnp.concatenate([earlier, new], axis=1)  # index span - 1 + t is the frame of step t
    window = jnp.arange(history_spacing - 1, span, history_spacing)
    frames = _take(sequence, times[..., None] + window)
    last_seen = _take(jnp.swapaxes(rollout.observation.last_seen, 0, 1), times)
    # evader[t] is the position after step t, that is one step ahead of the observation of step t
    ahead = jnp.array(policy.predictor.horizons) - 1
    positions = _take(jnp.swapaxes(rollout.evader, 0, 1), times[..., None] + ahead)
    return frames, last_seen, positions


def update_predictor(
    policy: Policy,
    optimiser: optax.GradientTransformation,
    history_spacing: int,
    parameters,
    optimiser_state,
    earlier: jax.Array,
    rollout: Rollout,
    keys: jax.Array,
    axis: str | None,
):
    """A few gradient steps on random windows of each environment; `keys` (E,).

    Returns:
        parameters, optimiser state, mean squared error () in m^2 per coordinate.
    """
    settings = policy.predictor
    room = rollout.reward.shape[0] - settings.horizons[-1] + 1
    times = jax.vmap(lambda key: jax.random.permutation(key, room)[: settings.windows])(keys)
    data = windows_and_labels(policy, history_spacing, earlier, rollout, times)
    # (steps, E, windows / steps, ...): every gradient step sees other windows of every environment
    data = jax.tree.map(
        lambda x: jnp.moveaxis(x.reshape(x.shape[0], settings.steps, -1, *x.shape[2:]), 1, 0), data
    )

    def loss(parameters, frames, last_seen, positions):
        predicted = policy.predict_from(parameters, frames, last_seen)
        return jnp.mean((predicted - positions) ** 2)

    def one(carry, batch):
        parameters, optimiser_state = carry
        value, gradient = jax.value_and_grad(loss)(parameters, *batch)
        value, gradient = mean_over_devices((value, gradient), axis)
        update, optimiser_state = optimiser.update(gradient, optimiser_state, parameters)
        return (optax.apply_updates(parameters, update), optimiser_state), value

    (parameters, optimiser_state), values = jax.lax.scan(one, (parameters, optimiser_state), data)
    return parameters, optimiser_state, jnp.mean(values)


def _take(values: jax.Array, index: jax.Array) -> jax.Array:
    """values (E, T, ...) at index (E, ...) along the second axis, per environment."""
    return jax.vmap(lambda v, i: v[i])(values, index)

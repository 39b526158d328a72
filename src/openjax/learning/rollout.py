"""Rollouts: the policy acts in all worlds for some steps."""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from openjax.policy import Policy, PolicyParameters, gaussian_log_prob
from openjax.pursuit import Observation, Pursuit, PursuitState


@struct.dataclass
class Rollout:
    """T steps of E worlds with N pursuers. Of the history only the newest frame of each step is kept."""

    observation: Observation  # (T, E, ...), before the step; `frames` (T, E, 1, F)
    predicted: jax.Array | None  # (T, E, K, 3) m, predicted evader positions; None without predictor
    action: jax.Array  # (T, E, N, A) samples of the policy's Gaussian
    log_prob: jax.Array  # (T, E, N)
    reward: jax.Array  # (T, E, N)
    terminated: jax.Array  # (T, E) bool
    truncated: jax.Array  # (T, E) bool
    evader: jax.Array  # (T, E, 3) m, true position after the step


def newest_frame(observation: Observation) -> Observation:
    """The observation with the newest frame only: the others are the frames of earlier steps."""
    return observation.replace(frames=observation.frames[..., -1:, :])


def collect(
    environment: Pursuit,
    policy: Policy,
    parameters: PolicyParameters,
    observation: Observation,
    state: PursuitState,
    noise: jax.Array,
    penalty_share: jax.Array | float = 1.0,
) -> tuple[Rollout, Observation, PursuitState]:
    """Act with exploration for T steps in E worlds.

    Args:
      environment: the game.
      policy: the networks.
      parameters: theirs.
      observation: (E, ...) of `state`.
      state: (E, ...).
      noise: (T, E, N, A) standard normal, drawn ahead in one go.
      penalty_share: () share of the reward's penalties that counts.

    Returns:
      the rollout, and observation and state after it.
    """
    number, pursuers = noise.shape[1], environment.settings.num_pursuers
    chex.assert_shape(noise, (None, None, pursuers, policy.sample_size))
    chex.assert_tree_shape_prefix((observation, state), (number,))
    step = jax.vmap(environment.step, in_axes=(None, 0, 0))
    unused_key = jax.random.key(0)

    def one(carry, noise):
        observation, state = carry
        predicted = policy.predict(parameters, observation)
        mean, log_std = policy.distribution(parameters.actor, observation, predicted)
        action = mean + jnp.exp(log_std) * noise
        log_prob = gaussian_log_prob(action, mean, log_std)
        following, state, reward, terminated, truncated, info = step(
            unused_key, state, policy.action(action, observation)
        )
        record = Rollout(
            observation=newest_frame(observation),
            predicted=predicted,
            action=action,
            log_prob=log_prob,
            reward=reward - (1.0 - penalty_share) * info.penalty,
            terminated=terminated,
            truncated=truncated,
            evader=state.evader_position,
        )
        return (following, state), record

    (observation, state), rollout = jax.lax.scan(one, (observation, state), noise)
    return rollout, observation, state

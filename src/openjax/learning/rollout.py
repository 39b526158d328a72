"""Rollouts: the policy acts in all worlds for some steps."""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from openjax.learning.evader_learning import EvaderLearning, EvaderSamples, LearningEvaders
from openjax.policy import Policy, PolicyParameters, gaussian_log_prob
from openjax.pursuit import Observation, Pursuit, PursuitState


@struct.dataclass
class Rollout:
    """T steps of E worlds with N pursuers. Of the history only the newest frame of each step is
    kept.
    """

    observation: Observation  # (T, E, ...), before the step; `frames` (T, E, 1, F)
    predicted: (
        jax.Array | None
    )  # (T, E, K, 3) m, predicted evader positions; None without predictor
    action: jax.Array  # (T, E, N, A) samples of the policy's Gaussian
    log_prob: jax.Array  # (T, E, N)
    reward: jax.Array  # (T, E, N)
    terminated: jax.Array  # (T, E) bool
    truncated: jax.Array  # (T, E) bool
    evader: jax.Array  # (T, E, 3) m, true position after the step
    learning: EvaderSamples | None = (
        None  # (T, E, ...), of the evaders that learn; None where none does
    )


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
    learning: tuple[EvaderLearning, LearningEvaders, jax.Array] | None = None,
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
      learning: how evaders learn, who they are, and noise (T, E, 3) for them; None: none learns.

    Returns:
      the rollout, and observation and state after it.
    """
    chex.assert_shape(noise, (None, None, environment.settings.num_pursuers, policy.sample_size))
    chex.assert_tree_shape_prefix((observation, state), noise.shape[1:2])
    step = jax.vmap(environment.step, in_axes=(None, 0, 0, 0 if learning else None))
    how, evaders, evader_noise = learning or (None, None, None)

    def one(carry, noise):
        (observation, state), (noise, evader_noise) = carry, noise
        wish, samples = how.act(evaders, state, evader_noise) if learning else (None, None)
        predicted = policy.predict(parameters, observation)
        mean, log_std = policy.distribution(parameters.actor, observation, predicted)
        action = mean + jnp.exp(log_std) * noise
        log_prob = gaussian_log_prob(action, mean, log_std)
        acted = policy.action(action, observation)
        following, state, reward, *ends, info = step(jax.random.key(0), state, acted, wish)
        record = Rollout(
            observation=newest_frame(observation),
            predicted=predicted,
            action=action,
            log_prob=log_prob,
            reward=reward - (1.0 - penalty_share) * info.penalty,
            terminated=ends[0],
            truncated=ends[1],
            evader=state.evader_position,
            learning=samples,
        )
        return (following, state), record

    (observation, state), rollout = jax.lax.scan(one, (observation, state), (noise, evader_noise))
    return rollout, observation, state

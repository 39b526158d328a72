"""Rollouts: the policy acts in all worlds for some steps."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from openjax.policy import Policy, PolicyParameters, gaussian_log_prob
from openjax.pursuit import Observation, Pursuit, PursuitState
from openjax.pursuit.shapes import Scalar


@struct.dataclass
class Rollout:
    """T steps of E worlds with N pursuers. Of the history only the newest frame of each
    step is kept.
    """

    observation: Observation  # (T, E, ...), before the step; `frames` (T, E, 1, F)
    predicted: jax.Array | None
    """(T, E, K, 3) m, predicted evader positions; None without predictor"""
    action: jax.Array  # (T, E, N, A) samples of the policy's Gaussian
    log_prob: jax.Array  # (T, E, N)
    reward: jax.Array  # (T, E, N)
    terminated: jax.Array  # (T, E) bool
    truncated: jax.Array  # (T, E) bool
    evader: jax.Array  # (T, E, 3) m, true position after the step
    learning: Any = None
    """Samples (T / hold, E, ...) of the evaders that learn; None where none does."""


def newest_frame(observation: Observation) -> Observation:
    """The observation with the newest frame only: the others are the frames of earlier
    steps.
    """
    return observation.replace(frames=observation.frames[..., -1:, :])


@dataclass(frozen=True)
class Players:
    """The players of a rollout."""

    environment: Pursuit
    policy: Policy
    parameters: PolicyParameters
    evaders: Callable[[PursuitState, jax.Array], tuple[jax.Array, Any]] | None = None
    """worlds (E, ...), noise (E, 3) -> desired velocities (E, 3) of evaders that learn,
    and their samples; None: none learns
    """
    hold: int = 1
    """Steps for which an evader that learns flies a decision."""


@struct.dataclass
class ExplorationNoise:
    """The exploration noise of a rollout, standard normal, drawn ahead in one go."""

    pursuers: jax.Array  # (T, E, N, A)
    evaders: jax.Array | None = None  # (T / hold, E, 3)


def collect(
    players: Players,
    world: tuple[Observation, PursuitState],
    noise: ExplorationNoise,
    penalty_share: Scalar | float = 1.0,
) -> tuple[Rollout, Observation, PursuitState]:
    """Act with exploration for T steps in E worlds.

    Args:
      players: who flies.
      world: observation and state (E, ...) before.
      noise: of all steps.
      penalty_share: () share of the reward's penalties that counts.

    Returns:
      the rollout, and observation and state after it.
    """
    pursuers = players.environment.settings.num_pursuers
    chex.assert_shape(noise.pursuers, (None, None, pursuers, players.policy.sample_size))
    chex.assert_tree_shape_prefix(world, noise.pursuers.shape[1:2])
    step = _step(players, penalty_share)
    if not players.evaders:
        (observation, state), rollout = jax.lax.scan(step, world, noise.pursuers)
        return rollout, observation, state

    def decide(world, noise):
        desired_velocities, samples = players.evaders(world[1], noise.evaders)

        def fly_on(world, noise):
            return step(world, noise, desired_velocities)

        world, record = jax.lax.scan(fly_on, world, noise.pursuers)
        return world, (record, samples)

    # two scans, one in the other: the evaders decide once, and their decision is flown
    # `hold` steps
    held_noise = noise.pursuers.reshape(-1, players.hold, *noise.pursuers.shape[1:])
    noise = noise.replace(pursuers=held_noise)
    (observation, state), (record, samples) = jax.lax.scan(decide, world, noise)
    rollout = jax.tree.map(lambda leaf: jax.lax.collapse(leaf, 0, 2), record)
    return rollout.replace(learning=samples), observation, state


def _step(players, penalty_share):
    """A control step of worlds (E, ...): worlds, noise (E, N, A) and desired velocities
    of evaders that learn -> worlds after it, record.
    """
    policy = players.policy
    move = jax.vmap(players.environment.step, in_axes=(None, 0, 0, 0 if players.evaders else None))

    def step(world, noise, desired_velocities=None):
        observation, state = world
        prediction, action, log_prob = _sample(players, observation, noise)
        command = policy.action(action, observation)
        # any key will do: the game draws nothing after its reset
        next_observation, state, reward, terminated, truncated, info = move(
            jax.random.key(0), state, command, desired_velocities
        )
        record = Rollout(
            observation=newest_frame(observation),
            predicted=prediction,
            action=action,
            log_prob=log_prob,
            # the reward holds the whole penalties: the share that doesn't count yet is
            # given back
            reward=reward - (1.0 - penalty_share) * info.penalty,
            terminated=terminated,
            truncated=truncated,
            evader=state.evader_position,
        )
        return (next_observation, state), record

    return step


def _sample(players, observation, noise):
    """Predictions, samples of the policy and their log probabilities."""
    policy = players.policy
    prediction = policy.predict(players.parameters, observation)
    mean, log_std = policy.distribution(players.parameters.actor, observation, prediction)
    action = mean + jnp.exp(log_std) * noise
    return prediction, action, gaussian_log_prob(action, mean, log_std)

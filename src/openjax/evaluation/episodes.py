"""Evaluation: whole episodes of the mean policy on given tasks."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from openjax.evaluation.message_settings import MessageSettings
from openjax.evaluation.messages import Hearsay
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import EpisodeStatistics, Pursuit, Task


@struct.dataclass
class Evaluation:
    """B episodes."""

    statistics: EpisodeStatistics  # (B,) each
    prediction_error: jax.Array
    """(B,) m, mean distance between predicted and true next position; NaN without
    predictor
    """
    last_seen_error: jax.Array  # (B,) m, the same for keeping the last seen position


@struct.dataclass
class EpisodeRecord:
    """B episodes of T steps, for pictures."""

    pursuers: jax.Array  # (B, T, N, 3) m
    quaternion: jax.Array  # (B, T, N, 4) wxyz
    evader: jax.Array  # (B, T, 3) m
    seen: jax.Array  # (B, T) bool
    captured: jax.Array  # (B, T, N) bool
    crashed: jax.Array  # (B, T, N) bool
    predicted: jax.Array | None  # (B, T, K, 3) m, predicted for the steps after


def make_evaluate(
    environment: Pursuit,
    policy: Policy,
    trajectory: bool = False,
    messages: MessageSettings | None = None,
) -> Callable[[PolicyParameters, Task, jax.Array], Evaluation | tuple[Evaluation, EpisodeRecord]]:
    """`evaluate(parameters, tasks, key)`: one episode per task (leading axis B), to be
    compiled by the caller.

    With `trajectory` it returns positions of every step as well. Where `messages` get
    lost or are late, each pursuer flies by what it believes, and prediction errors
    aren't told.
    """
    imperfect = messages is not None and not messages.perfect
    hearsay = Hearsay(messages, environment) if imperfect else None
    return _Episodes(environment, policy, trajectory, hearsay).evaluate


def make_evaluate_vehicles(
    environment: Pursuit, policy: Policy
) -> Callable[[PolicyParameters, Task, jax.Array, jax.Array], Evaluation]:
    """The same as a function of the bounds (R, 4) of vehicles, too: `evaluate(parameters,
    tasks, key, bounds)`.
    """

    def evaluate(parameters, tasks, key, bounds):
        return make_evaluate(environment.with_bounds(bounds), policy)(parameters, tasks, key)

    return evaluate


@dataclass(frozen=True)
class _Episodes:
    """Whole episodes of a policy, as one function of its parameters and tasks."""

    environment: Pursuit
    policy: Policy
    trajectory: bool
    hearsay: Hearsay | None

    def evaluate(self, parameters: PolicyParameters, tasks: Task, key: jax.Array):
        environment = self.environment
        number = tasks.evader_position.shape[0]
        reset_key, step_key = jax.random.split(key)
        reset_keys = jax.random.split(reset_key, number)
        observation, state = jax.vmap(environment.reset_to)(reset_keys, tasks)
        beliefs = None if self.hearsay is None else jax.vmap(self.hearsay.start)(state)
        start = (observation, state, beliefs, jnp.zeros((2, number), jnp.float32))

        length = environment.settings.episode_length
        step = functools.partial(self._step, parameters)
        (_, state, _, errors), record = jax.lax.scan(
            step, start, jax.random.split(step_key, length)
        )
        prediction_error, last_seen_error = errors / length
        if not self.policy.predictor.enabled or self.hearsay is not None:
            prediction_error = jnp.full_like(prediction_error, jnp.nan)
        evaluation = Evaluation(state.statistics, prediction_error, last_seen_error)
        if not self.trajectory:
            return evaluation
        # from steps first, as a scan stacks them, to episodes first
        return evaluation, jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), record)

    def _step(self, parameters, carry, key):
        """One step of all episodes; `errors` (2, B) m add up those of the prediction
        and of the last seen position.
        """
        observation, state, beliefs, errors = carry
        action, prediction = self._decide(parameters, observation, state, beliefs)
        last_seen = observation.last_seen
        # what was predicted one step ahead is compared with where the evader is after
        # the step
        step = jax.vmap(self.environment.step, in_axes=(None, 0, 0))
        observation, state, _, _, _, info = step(key, state, action)
        if self.hearsay is not None:
            keys = jax.random.split(key, action.shape[0])
            beliefs = jax.vmap(self.hearsay.update)(beliefs, state, keys)
        guesses = [last_seen if prediction is None else prediction[:, 0], last_seen]
        errors = errors + jnp.stack(
            [jnp.linalg.norm(guess - state.evader_position, axis=-1) for guess in guesses]
        )
        record = None
        if self.trajectory:
            record = EpisodeRecord(
                pursuers=state.drones.position,
                quaternion=state.drones.quaternion,
                evader=state.evader_position,
                seen=info.seen,
                captured=info.captured,
                crashed=info.crashed,
                predicted=prediction,
            )
        return (observation, state, beliefs, errors), record

    def _decide(self, parameters, observation, state, beliefs):
        """Actions, and the positions predicted for the evader; None where each pursuer
        has its own view.
        """
        policy = self.policy
        if self.hearsay is not None:
            views = jax.vmap(self.hearsay.observations)(beliefs, state)
            # (B, N, 1, 4): each view's policy acts for its own pursuer
            return policy.act(parameters, views)[..., 0, :], None
        prediction = policy.predict(parameters, observation)
        mean, _ = policy.distribution(parameters.actor, observation, prediction)
        return policy.action(mean, observation), prediction


def summarise(evaluation: Evaluation) -> dict[str, float]:
    """Captures, breaches, crashes and errors as means over the episodes, capture steps
    of the slowest hundredth too.
    """
    # on the host: on a device, each of these few numbers is a program of its own
    statistics = jax.tree.map(np.asarray, evaluation.statistics)
    hundredth = max(1, len(statistics.capture_step) // 100)
    slowest = np.sort(statistics.capture_step)[-hundredth:]
    steps = np.maximum(statistics.steps, 1)

    def mean(x):
        return float(np.mean(np.asarray(x, np.float32)))

    return {
        "capture_rate": mean(statistics.captured),
        "capture_step": mean(statistics.capture_step),
        "slowest_capture_step": mean(slowest),
        "collision_rate": mean(statistics.collision_steps / steps),
        "collision_parts": {
            "pillar": mean(statistics.pillar_steps / steps),
            "drone": mean(statistics.drone_steps / steps),
            "bounds": mean(statistics.bounds_steps / steps),
        },
        "crash_rate": mean(statistics.crashed),
        "over_speed_rate": mean(statistics.over_speed_steps / steps),
        "prediction_error": mean(evaluation.prediction_error),
        "last_seen_error": mean(evaluation.last_seen_error),
        "episode_return": mean(statistics.episode_return),
    }


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson 1927), by the quantile 1.96 that all pages
    of results have.
    """
    p = hits / n
    z = 1.96
    centre = p + z * z / (2 * n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    # rounding may lead past the ends
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)

"""Flights for the paper's tables: many episodes of one policy in one compiled call, each with its
own evader speed.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from flax import struct

from openjax.evaluation.episodes import Evaluation
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Pursuit, PursuitSettings, Task
from openjax.pursuit.reward import captures


@dataclasses.dataclass(frozen=True)
class SweptSettings(PursuitSettings):
    """Settings with a traced evader speed, so that one compiled function serves all."""

    def __post_init__(self):
        """A traced number can't be checked; those swept over are positive."""


@struct.dataclass
class Flights:
    """B episodes of the mean policy."""

    evaluation: Evaluation  # (B,) each
    first: jax.Array
    """(B, R) int32, first step with a capture within each radius; episode length + 1 where there is
    none.
    """


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def fly(
    environment: Pursuit,
    policy: Policy,
    radii: tuple[float, ...],
    parameters: PolicyParameters,
    tasks: Task,
    speeds: jax.Array,
    key: jax.Array,
) -> Flights:
    """One episode per task (leading axis B), with evader speeds (B,) in m/s; `key` draws the start
    attitudes.

    A radius changes nothing but what counts as a capture, so each flight tells it for all `radii`
    (m).
    """
    settings = environment.settings
    plain = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    no_capture = settings.episode_length + 1
    number = speeds.shape[0]

    def step(state, action, speed):
        swept = dataclasses.replace(
            environment, settings=SweptSettings(**{**plain, "evader_speed": speed})
        )
        return swept.step(jax.random.key(0), state, action)[:2]

    def caught(state):
        games = [dataclasses.replace(settings, capture_radius=radius) for radius in radii]
        where = (state.drones.position, state.evader_position, state.in_sight)
        each = [captures(game, *where) for game in games]
        return jnp.any(jnp.stack(each), axis=-1)

    def one(carry, _):
        observation, state, first, errors = carry
        predicted = policy.predict(parameters, observation)
        mean, _ = policy.distribution(parameters.actor, observation, predicted)
        last_seen = observation.last_seen
        observation, state = jax.vmap(step)(state, policy.action(mean, observation), speeds)
        capture_step = jnp.where(jax.vmap(caught)(state), state.step[:, None], no_capture)
        guesses = jnp.stack([last_seen if predicted is None else predicted[:, 0], last_seen])
        errors = errors + jnp.linalg.norm(guesses - state.evader_position, axis=-1)
        return (observation, state, jnp.minimum(first, capture_step), errors), None

    observation, state = jax.vmap(environment.reset_to)(jax.random.split(key, number), tasks)
    first = jnp.full((number, len(radii)), no_capture, jnp.int32)
    start = (observation, state, first, jnp.zeros((2, number), jnp.float32))
    (_, state, first, errors), _ = jax.lax.scan(one, start, length=settings.episode_length)
    predicted, last_seen = errors / settings.episode_length
    return Flights(
        evaluation=Evaluation(
            statistics=state.statistics,
            prediction_error=predicted
            if policy.predictor.enabled
            else jnp.full_like(predicted, jnp.nan),
            last_seen_error=last_seen,
        ),
        first=first,
    )


@functools.cache
def environment_of(settings: PursuitSettings) -> Pursuit:
    """The same object for the same game: what is compiled is found again by it."""
    return Pursuit(settings)

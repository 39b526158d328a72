"""Flights of a fixed policy as arrays, for studies of prediction: many worlds in one compiled call."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import (
    SCENARIOS,
    Pursuit,
    PursuitSettings,
    Task,
    expand_task,
    scenario_task,
    turn_task,
    uniform_task,
)
from openjax.pursuit.evaders import field_velocity
from openjax.pursuit.sensing import line_of_sight

SOURCES = ("its own predictor", "last seen position", "constant velocity", "true position and velocity")
"""What a flown policy is told as predicted positions."""


@struct.dataclass
class Flights:
    """B episodes of T steps of N pursuers; index t is what is known before step t + 1."""

    pursuers: jax.Array  # (B, T, N, 3) m
    evader: jax.Array  # (B, T + 1, 3) m, true position, also after the last step
    velocity: jax.Array  # (B, T, 3) m/s, of the evader in the step before
    seen: jax.Array  # (B, T) bool
    pillar_position: jax.Array  # (B, P, 2) m
    pillar_active: jax.Array  # (B, P) bool
    last_index: jax.Array  # (B, T) int32, when the evader was last seen; -1 before it ever was


def training_tasks(settings: PursuitSettings, key: jax.Array, number: int, expansions: int) -> Task:
    """Tasks as a run with the generator sees them: uniform ones, turned, and 0 to `expansions` times expanded."""

    def draw(key):
        uniform_key, turn_key, number_key, expand_key = jax.random.split(key, 4)
        task = turn_task(turn_key, uniform_task(settings, uniform_key))
        wanted = jax.random.randint(number_key, (), 0, expansions + 1)

        def expand(task, step):
            index, key = step
            further = expand_task(settings, key, task)
            return jax.tree.map(lambda a, b: jnp.where(index < wanted, a, b), further, task), None

        steps = (jnp.arange(expansions), jax.random.split(expand_key, expansions))
        return jax.lax.scan(expand, task, steps)[0]

    return jax.jit(jax.vmap(draw))(jax.random.split(key, number))


def layout_tasks(settings: PursuitSettings, episodes: int) -> Task:
    """`episodes` copies of each of the six layouts, one layout after the other."""
    tasks = [scenario_task(settings, scenario) for scenario in SCENARIOS.values()]
    return jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), episodes, axis=0), *tasks)


def with_slots(tasks: Task, slots: int) -> Task:
    """The tasks with `slots` pillar slots."""
    extra = slots - tasks.pillar_active.shape[-1]
    return tasks.replace(
        pillar_position=jnp.pad(tasks.pillar_position, ((0, 0), (0, extra), (0, 0))),
        pillar_active=jnp.pad(tasks.pillar_active, ((0, 0), (0, extra))),
    )


@functools.partial(jax.jit, static_argnums=(0, 1))
def fly(
    environment: Pursuit,
    policy: Policy,
    parameters: PolicyParameters,
    tasks: Task,
    source: jax.Array,
    exploration: jax.Array,
    key: jax.Array,
) -> tuple[Flights, jax.Array]:
    """One episode per task.

    Args:
        environment: the game.
        policy: the networks.
        parameters: theirs.
        tasks: leading axis B.
        source: (B,) int, index in `SOURCES`: what the policy is told.
        exploration: (B,) 0 flies the mean, 1 with the exploration of training.
        key: of start attitudes and exploration.

    Returns:
        flights, and (B, 3) captured, capture step and collision rate of each.
    """
    settings = environment.settings
    number = source.shape[0]
    reset_key, noise_key = jax.random.split(key)
    observation, state = jax.vmap(environment.reset_to)(jax.random.split(reset_key, number), tasks)
    ahead = settings.time_step * jnp.array(policy.predictor.horizons, jnp.float32)[:, None]
    step = jax.vmap(environment.step, in_axes=(None, 0, 0))

    def told(observation, state, last_velocity, age):
        predicted = policy.predict(parameters, observation)
        if predicted is None:
            return None
        kept = jnp.broadcast_to(observation.last_seen[:, None], predicted.shape)
        straight = inside(settings, kept + last_velocity[:, None] * (age[:, None, None] + ahead))
        true = inside(settings, state.evader_position[:, None] + state.evader_velocity[:, None] * ahead)
        chosen = source[:, None, None]
        return jnp.select([chosen == 0, chosen == 1, chosen == 2], [predicted, kept, straight], true)

    def one(carry, key):
        observation, state, last_velocity, age = carry
        predicted = told(observation, state, last_velocity, age)
        mean, log_std = policy.distribution(parameters.actor, observation, predicted)
        noise = exploration[:, None, None] * jax.random.normal(key, mean.shape)
        record = (state.drones.position, state.evader_position, state.evader_velocity, state.seen)
        observation, state, *_ = step(key, state, policy.action(mean + jnp.exp(log_std) * noise))
        last_velocity = jnp.where(state.seen[:, None], state.evader_velocity, last_velocity)
        age = jnp.where(state.seen, 0.0, age + settings.time_step)
        return (observation, state, last_velocity, age), record

    start = (observation, state, jnp.zeros((number, 3)), jnp.zeros(number))
    keys = jax.random.split(noise_key, settings.episode_length)
    (_, state, _, _), record = jax.lax.scan(one, start, keys)
    pursuers, evader, velocity, seen = (jnp.moveaxis(leaf, 0, 1) for leaf in record)
    index = jnp.arange(settings.episode_length, dtype=jnp.int32)
    flights = Flights(
        pursuers=pursuers,
        evader=jnp.concatenate([evader, state.evader_position[:, None]], axis=1),
        velocity=velocity,
        seen=seen,
        pillar_position=tasks.pillar_position,
        pillar_active=tasks.pillar_active,
        last_index=jax.lax.cummax(jnp.where(seen, index, -1), axis=1),
    )
    counted = state.statistics
    return flights, jnp.stack([counted.captured, counted.capture_step, counted.collision_rate], axis=-1)


def inside(settings: PursuitSettings, position: jax.Array) -> jax.Array:
    """(..., 3) positions moved to the nearest point of the arena."""
    radius = jnp.linalg.norm(position[..., :2], axis=-1, keepdims=True)
    xy = position[..., :2] * jnp.minimum(1.0, settings.arena_radius / jnp.maximum(radius, 1e-6))
    return jnp.concatenate([xy, jnp.clip(position[..., 2:], 0.0, settings.arena_height)], axis=-1)


def last_known(settings: PursuitSettings, flights: Flights) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where the evader was last seen (B, T, 3), its velocity then (B, T, 3) and the time since (B, T) in s.

    Before it was ever seen: the arena's middle, at rest, the time since the start.
    """
    index = flights.last_index
    ever = (index >= 0)[..., None]
    world = jnp.arange(index.shape[0])[:, None]
    middle = jnp.array(settings.middle, jnp.float32)
    at = jnp.maximum(index, 0)
    position = jnp.where(ever, flights.evader[world, at], middle)
    velocity = jnp.where(ever, flights.velocity[world, at], 0.0)
    return position, velocity, settings.time_step * (jnp.arange(index.shape[1]) - index)


def evader_rule(
    settings: PursuitSettings, flights: Flights, times: np.ndarray, horizons: tuple[int, ...]
) -> jax.Array:
    """(B, times, K, 3) positions by the evader's own rule from where it was last seen.

    No competitor, as it knows the rule and the pillars: a bound on what there is to be learnt. While nobody sees it,
    pursuers don't move it; from the present on they're taken to fly straight on.
    """
    dt = settings.time_step
    middle = jnp.array(settings.middle, jnp.float32)

    def of_world(flight):
        pillars = flight.pillar_position, flight.pillar_active

        def moved(evader, pursuers, known):
            in_sight = line_of_sight(settings, pursuers, evader, *pillars) & known
            return evader + dt * field_velocity(settings, evader, pursuers, in_sight, *pillars)

        def track(believed, now):
            true, seen, pursuers = now
            believed = jnp.where(seen, true, believed)
            return moved(believed, pursuers, seen), believed

        now = (flight.evader[:-1], flight.seen, flight.pursuers)
        believed = jax.lax.scan(track, middle, now)[1]
        speed = flight.pursuers[times] - flight.pursuers[np.maximum(times - 1, 0)]  # m per step

        def ahead(carry, _):
            evader, pursuers = carry
            evader = jax.vmap(moved, in_axes=(0, 0, None))(evader, pursuers, True)
            return (evader, pursuers + speed), evader

        start = (believed[times], flight.pursuers[times])
        path = jax.lax.scan(ahead, start, None, length=horizons[-1])[1]
        return jnp.moveaxis(path[np.array(horizons) - 1], 0, 1)

    return jax.lax.map(of_world, flights, batch_size=256)

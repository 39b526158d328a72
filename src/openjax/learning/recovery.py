"""What a policy does in the first moments of an episode, learnt by the gradient through the simulation.

Starts lean by up to 36 degrees, some beside a pillar or another pursuer, and MAPPO is a poor teacher of the quarter of a second
that decides them: its noise averages out in the motors, and a crash says little of what would have avoided it. The equations
of motion know: here the actor follows the gradient of a smooth share of crashes through some fifty steps of free flight
(Xu et al. 2022, short-horizon actor-critic, without the critic). In the rest of the flight it is held to what it did, but
for speeds over the limit.
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import (
    Pursuit,
    PursuitSettings,
    RewardSettings,
    Task,
    close_starts,
    turn_task,
    uniform_task,
)
from openjax.pursuit.collisions import TOUCH, drone_distance, pillar_distance
from openjax.vehicle import Vehicle
from openjax.vehicle.family import family_bounds, narrowed_bounds
from openjax.vehicle.solids import DRONE_RADIUS

STEPS = 50
"""Control steps that are learnt at once."""
SEGMENTS = 8
"""A flight is looked at after each of so many times `STEPS`."""
SMOOTH = 0.012
"""Gap (m) over which a crash goes from sure to none in what is learnt."""
LOWEST, FASTEST = 0.35, 1.0
"""Height (m) below, and speed (m/s) above which the end of a start costs."""
CLOSE, SIDE_BY_SIDE = 0.45, 0.35
"""Shares of the starts close to something (70 % of the pursuers), and of those in which all stand side by side."""
APART = 0.1
"""Farthest gap beyond the safety distance of pursuers side by side (m)."""


@dataclass(frozen=True)
class RecoverySettings:
    """How the first moments are learnt."""

    updates: int = 200
    worlds: int = 320
    learning_rate: float = 3e-4
    """Adam's step size at the start; falls linearly."""
    hold: float = 0.05
    """Weight of the squared change of the actions in flight, in standard deviations of the policy's."""
    speed: float = 0.0
    """Weight of speeds above `speed_from` in flight, per (m/s)."""
    speed_from: float = 0.97
    """Share of the maximal speed."""
    nominal: float = 0.0
    """Share of the flights with nominal vehicles instead of those that are learnt on."""
    seed: int = 0


def side_by_side(settings: PursuitSettings, key: jax.Array, task: Task) -> Task:
    """A task whose pursuers all start 0 to 0.1 m outside the safety distance of one before them, if that is clear of pillars."""
    position = task.pursuer_position
    for i, own_key in enumerate(jax.random.split(key, position.shape[0] - 1), start=1):
        which_key, direction_key, gap_key = jax.random.split(own_key, 3)
        away = jax.random.normal(direction_key, (3,)) * jnp.array([1.0, 1.0, 0.3])
        gap = settings.drone_clearance + jax.random.uniform(gap_key, (), maxval=APART)
        beside = position[jax.random.randint(which_key, (), 0, i)] + gap * away / jnp.linalg.norm(away)
        position = position.at[i].set(beside)
    pillars = jnp.linalg.norm(position[:, None, :2] - task.pillar_position[None], axis=-1)
    near = task.pillar_active & (pillars < settings.pillar_radius + settings.pillar_clearance)
    clear = ~jnp.any(near) & jnp.all(drone_distance(position) >= settings.drone_clearance - TOUCH)
    return task.replace(pursuer_position=jnp.where(clear, position, task.pursuer_position))


def draw_start(settings: PursuitSettings, key: jax.Array) -> Task:
    """A task to learn from: close to something, side by side, or any."""
    task_key, turn_key, start_key, choice_key = jax.random.split(key, 4)
    task = turn_task(turn_key, uniform_task(settings, task_key))
    near = close_starts(settings, start_key, task, 0.7)
    beside = side_by_side(settings, start_key, task)
    kind = jax.random.uniform(choice_key)
    return jax.tree.map(
        lambda a, b, c: jnp.where(kind < CLOSE, a, jnp.where(kind < CLOSE + SIDE_BY_SIDE, b, c)),
        near,
        beside,
        task,
    )


class Recovery:
    """A policy's game in free flight, and what is learnt in it. Bounds (R, 4) are those of `settings.vehicles`."""

    def __init__(self, game: PursuitSettings, vehicle: Vehicle, policy: Policy, parameters: PolicyParameters):
        """`game`: with a family of vehicles; `parameters` are the policy's, whose predictor stays as it is."""
        self.vehicle, self.policy, self.parameters = vehicle, policy, parameters
        self.settings = dataclasses.replace(
            game,
            physics="rigid",
            contacts=False,
            speed_limit="none",
            start_attitude="drawn",
            reward=RewardSettings(),
        )

    def shown(self, environment: Pursuit, observation, state):
        """What the actor is shown of a world: its observation."""
        del environment, state
        return observation

    def begin(self, tasks: Task, keys: jax.Array, bounds: jax.Array):
        """Observations and states (B, ...) of tasks, whose vehicles have bounds (B, R, 4) each."""

        def one(key, task, bounds):
            return Pursuit(self.settings, self.vehicle, vehicle_bounds=bounds).reset_to(key, task)

        return jax.vmap(one)(keys, tasks, bounds)

    def fly(self, actor: Any, world, steps: int, fast: float = 1.0):
        """`world`, observations and states (B, ...), after some steps.

        Returns:
          the world, the least gaps (B, N) to anything solid (m), and mean speeds (B, N) above `fast` (m/s).
        """
        environment = Pursuit(self.settings, self.vehicle)
        step = jax.vmap(environment.step, in_axes=(None, 0, 0))
        tasks = world[1].task
        pillars, active = tasks.pillar_position, tasks.pillar_active[:, None]

        def one(carry, _):
            (observation, state), least, over = carry
            shown, predicted = self._inputs(observation, state)
            action = self.policy.action(self.policy.distribution(actor, shown, predicted)[0])
            observation, state, *_ = step(jax.random.key(0), state, action)
            position = state.drones.position
            to_pillar = jax.vmap(lambda p, q: pillar_distance(self.settings, p, q))(position, pillars)
            gap = jnp.min(jnp.where(active, to_pillar, jnp.inf), axis=-1) - DRONE_RADIUS
            gap = jnp.minimum(gap, jnp.min(jax.vmap(drone_distance)(position), axis=-1) - 2 * DRONE_RADIUS)
            gap = jnp.minimum(gap, position[..., 2] - DRONE_RADIUS)
            over = over + jax.nn.relu(_speed(state.drones) - fast)
            return ((observation, state), jnp.minimum(least, gap), over), None

        shape = tasks.pursuer_position.shape[:2]
        first = world, jnp.full(shape, jnp.inf), jnp.zeros(shape)
        (world, least, over), _ = jax.lax.scan(jax.checkpoint(one), first, None, length=steps)
        return world, least, over / steps

    def _inputs(self, observation, state):
        environment = Pursuit(self.settings, self.vehicle)
        shown = jax.vmap(lambda observation, state: self.shown(environment, observation, state))(
            observation, state
        )
        return shown, jax.lax.stop_gradient(self.policy.predict(self.parameters, observation))

    def starts(self, key: jax.Array, number: int, bounds: jax.Array):
        """A world (number, ...) to learn from."""
        task_key, reset_key = jax.random.split(key)
        tasks = jax.vmap(lambda key: draw_start(self.settings, key))(jax.random.split(task_key, number))
        return self.begin(tasks, jax.random.split(reset_key, number), bounds)

    def flights(self, actor: Any, key: jax.Array, number: int, bounds: jax.Array):
        """Worlds (SEGMENTS * number, ...) at moments of flights by `actor`."""

        def segment(world, _):
            world = self.fly(actor, world, STEPS)[0]
            return world, world

        worlds = jax.lax.scan(segment, self.starts(key, number, bounds), None, length=SEGMENTS)[1]
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), worlds)

    def loss(self, how: RecoverySettings, actor: Any, before: Any, starts, flying) -> jax.Array:
        """What is learnt (): a smooth share of crashes in the `starts`, that don't end fast or low, and `flying` as `before`."""
        world, least, _ = self.fly(actor, starts, STEPS)
        crash = jnp.mean(jax.nn.sigmoid((3 * TOUCH - least) / SMOOTH))
        drones = world[1].drones
        fast, low = _speed(drones) - FASTEST, LOWEST - drones.position[..., 2]
        total = crash + 0.2 * (jnp.mean(jax.nn.relu(fast)) + jnp.mean(jax.nn.relu(low)))
        inputs = self._inputs(*flying)
        mean, log_std = self.policy.distribution(before, *inputs)
        change = (self.policy.distribution(actor, *inputs)[0] - mean) * jnp.exp(-log_std)
        total = total + how.hold * jnp.mean(jnp.sum(change**2, axis=-1))
        if how.speed:
            limit = how.speed_from * self.settings.max_speed
            total = total + how.speed * jnp.mean(self.fly(actor, flying, STEPS, limit)[2])
        return total

    def learn(self, how: RecoverySettings, actor: Any, bounds: jax.Array, look=None) -> Any:
        """The actor after learning on vehicles within `bounds` (R, 4).

        Args:
          how: sizes and weights.
          actor: parameters to begin with.
          bounds: of the vehicles.
          look: called with the number of updates done, their whole number and the actor, at the start and after each.
        """
        optimiser = optax.chain(
            optax.clip_by_global_norm(1.0),
            optax.adam(optax.linear_schedule(how.learning_rate, 0.0, how.updates)),
        )
        every = jnp.broadcast_to(bounds, (how.worlds, *bounds.shape))
        plain = jnp.arange(how.worlds)[:, None, None] < how.nominal * how.worlds
        mixed = jnp.where(plain, narrowed_bounds(self.settings.vehicles, 0.0), every)

        def update(actor, state, before, flights, key):
            start_key, choice_key = jax.random.split(key)
            chosen = jax.random.randint(choice_key, (how.worlds,), 0, SEGMENTS * how.worlds)
            flying = jax.tree.map(lambda leaf: leaf[chosen], flights)
            starts = self.starts(start_key, how.worlds, every)
            gradient = jax.grad(lambda actor: self.loss(how, actor, before, starts, flying))(actor)
            # a world that tumbles may have no gradient
            finite = jnp.isfinite(optax.global_norm(gradient))
            gradient = jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), gradient)
            change, state = optimiser.update(gradient, state)
            return optax.apply_updates(actor, change), state

        key, before, state = jax.random.key(how.seed), actor, optimiser.init(actor)
        record = jax.jit(lambda actor, key: self.flights(actor, key, how.worlds, mixed))
        kinds = jax.eval_shape(record, actor, key)
        lowered = [
            record.lower(actor, key),
            jax.jit(update).lower(actor, state, before, kinds, key),
        ]
        with ThreadPoolExecutor() as pool:
            record, update = pool.map(lambda program: program.compile(), lowered)
        flights = record(before, jax.random.fold_in(key, how.updates))
        for i in range(how.updates):
            if look is not None:
                look(i, actor)
            actor, state = update(actor, state, before, flights, jax.random.fold_in(key, i))
        if look is not None:
            look(how.updates, actor)
        return actor


def _speed(drones):
    return jnp.sqrt(jnp.sum(drones.velocity**2, axis=-1) + 1e-9)


def recovered(
    how: RecoverySettings,
    game: PursuitSettings,
    vehicle: Vehicle,
    policy: Policy,
    parameters: PolicyParameters,
) -> PolicyParameters:
    """Parameters of a policy that has learnt the first moments on the family of `game`.

    Args:
      how: sizes and weights.
      game: the policy's, with the vehicles to learn on.
      vehicle: what they are variations of.
      policy: the networks; its actions must be commands.
      parameters: theirs.
    """
    bounds = jnp.asarray(family_bounds(game.vehicles))
    recovery = Recovery(game, vehicle, policy, parameters)
    return parameters.replace(actor=recovery.learn(how, parameters.actor, bounds))

"""The game around vehicles that fly elsewhere, and the policy's episodes in each of the three worlds.

The game (evader, line of sight, observation, metrics) is `openjax.pursuit`'s own step, in which only the
drones' step is replaced by poses from outside.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.task_gap.air import Air, Solids
from experiments.withheld import body, causes, sensors
from experiments.withheld.cases import case_rng
from openjax.pursuit import Pursuit, PursuitSettings, action_to_command, uniform_task
from openjax.pursuit.reward import captures
from openjax.pursuit.sensing import line_of_sight
from openjax.vehicle import DroneState

FIGURES = ("captured", "capture_step", "collision_rate", "crashed")
CLOSE = 0.5  # of the capture radius: the whole one is reached in nearly every episode, so it says little
TASK_KEY = 7_000_001  # tasks and start attitudes are the same in all worlds


class FlownElsewhere:
    """Stands in for a drones' step: the next state and what is seen of it lie in the drones' memory."""

    def reset(self, vehicle, drones: DroneState, key=None) -> DroneState:
        """Drones that are where they are, and seen there."""
        del vehicle, key
        return remember(drones, pose_of(drones), pose_of(drones))

    def __call__(self, vehicle, drones: DroneState, *_) -> DroneState:
        """The drones where they were flown to."""
        del vehicle
        return drones.replace(**drones.effect_memory["flown"])

    def seen(self, drones: DroneState, effect_parameters=None) -> DroneState:
        """The drones as they were measured."""
        del effect_parameters
        return drones.replace(**drones.effect_memory["seen"])


def pose_of(drones: DroneState) -> dict:
    """What a world elsewhere says of drones."""
    return {name: getattr(drones, name) for name in ("position", "quaternion", "velocity")}


def remember(drones: DroneState, flown: dict, seen: dict) -> DroneState:
    """The drones with their next state and what is seen of it in their memory."""
    return drones.replace(effect_memory={"flown": flown, "seen": seen})


class FlownPursuit(Pursuit):
    """The game of drones that fly elsewhere."""

    def __init__(self, settings: PursuitSettings):
        super().__init__(settings)
        self._drones_step = FlownElsewhere()


def draw_tasks(settings: PursuitSettings, start: int, number: int):
    """Tasks number `start` to `start + number` of the uniform draw, and their reset keys."""
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(TASK_KEY)))(jnp.arange(start, start + number))
    pairs = jax.vmap(jax.random.split)(keys)
    return jax.vmap(partial(uniform_task, settings))(pairs[:, 0]), pairs[:, 1]


def catches_closely(settings: PursuitSettings, state) -> jax.Array:
    """Whether some pursuer of each world catches the evader within half of the capture radius now. (B,) bool.

    The policy doesn't know the capture radius, so this is the game with the smaller one.
    """
    smaller = dataclasses.replace(settings, capture_radius=CLOSE * settings.capture_radius)

    def caught(position, evader, task):
        sight = line_of_sight(settings, position, evader, task.pillar_position, task.pillar_active)
        return jnp.any(captures(smaller, position, evader, sight))

    return jax.vmap(caught)(state.drones.position, state.evader_position, state.task)


def figures_of(statistics, closely) -> dict[str, list[float]]:
    """The task's figures of each episode, and the parts of the collisions."""
    steps = np.maximum(np.asarray(statistics.steps), 1)
    out = {name: np.asarray(getattr(statistics, name), float) for name in FIGURES}
    out["captured_closely"] = np.asarray(closely, float)
    for part in ("pillar", "drone", "bounds"):
        out[f"collision_{part}"] = np.asarray(getattr(statistics, f"{part}_steps"), float) / steps
    return {name: [round(float(x), 6) for x in values] for name, values in out.items()}


def fly_simulator(loaded, settings, start, number, effects=(), parameters=None) -> dict[str, list[float]]:
    """Episodes in the simulator, nominal or with effects."""
    tasks, keys = draw_tasks(settings, start, number)

    def episodes(weights, tasks, keys, parameters):  # parameters as arguments: one program for an effect
        environment = Pursuit(settings, effects=effects, effect_parameters=parameters)
        step = jax.vmap(environment.step, in_axes=(None, 0, 0))

        def one(carry, _):
            observation, state, closely = carry
            observation, state, *_ = step(keys[0], state, loaded.policy.act(weights, observation))
            return (observation, state, closely | catches_closely(settings, state)), None

        carry = (*jax.vmap(environment.reset_to)(keys, tasks), jnp.zeros(number, bool))
        (_, state, closely), _ = jax.lax.scan(one, carry, None, length=settings.episode_length)
        return state.statistics, closely

    return figures_of(*jax.jit(episodes)(loaded.parameters, tasks, keys, parameters or {}))


def fly_plant(loaded, settings, start, number, case) -> dict[str, list[float]]:
    """Episodes in the withheld plant with the causes of `case`; `flights.Case` says which vehicle flies."""
    game = FlownPursuit(settings)
    team = settings.num_pursuers
    tasks, keys = draw_tasks(settings, start, number)
    state = jax.jit(jax.vmap(game.reset_to))(keys, tasks)[1]
    air = make_air(settings, state, tasks, start, case)

    @jax.jit
    def look(weights, state, seen):
        state = state.replace(drones=remember(state.drones, pose_of(state.drones), seen))
        action = loaded.policy.act(weights, jax.vmap(game.observe)(state))
        return action, action_to_command(action)

    @jax.jit
    def advance(state, closely, action, flown):
        state = state.replace(drones=remember(state.drones, flown, flown))
        state = jax.vmap(game.step, in_axes=(None, 0, 0))(keys[0], state, action)[1]
        return state, closely | catches_closely(settings, state)

    def per_world(position, quaternion, velocity):
        parts = {"position": position, "quaternion": quaternion, "velocity": velocity}
        return {
            name: value.T.reshape(-1, team, len(value)).astype(np.float32) for name, value in parts.items()
        }

    closely = jnp.zeros(number, bool)
    limit = settings.max_speed if settings.speed_limit == "clamp" else None
    for _ in range(settings.episode_length):
        action, command = look(loaded.parameters, state, per_world(*air.measure()))
        air.fly(np.asarray(command, float).reshape(-1, 4).T, limit)
        flown = per_world(air.position, air.q, air.velocity)
        state, closely = advance(state, closely, action, flown)
    return figures_of(state.statistics, closely)


def make_air(settings, state, tasks, start, case) -> Air:
    """The plant's bodies at the start of the episodes: pursuers of a world are neighbours."""
    ticks, team = settings.episode_length, settings.num_pursuers
    worlds = tasks.evader_position.shape[0]
    count = worlds * team
    noises = []
    for world in range(worlds):
        rng = case_rng(case.seed, case.number, 3, start + world)
        voltage = case.shared["voltage"] + rng.uniform(-0.25, 0.15)
        for _ in range(team):
            drawn = sensors.draw_flight(rng, case.shared, ticks, voltage + rng.uniform(-0.02, 0.02))
            noises.append({name: value for name, value in drawn.items() if name not in ("gyro", "accel")})
    parameters = body.nominal_parameters(count)
    parameters["rotor_gain"] *= 1 + case.shared["thrust_offset"]
    arrival = np.repeat(10.0 * np.arange(ticks)[:, None], count, axis=1)
    if case.cause is not None:
        rng = case_rng(case.seed, case.number, 4, start)
        causes.apply(case.cause, parameters, np.arange(count), arrival, rng)
    index = np.arange(count).reshape(worlds, team)
    pillars = np.asarray(tasks.pillar_position, float)  # (worlds, P, 2)
    solids = Solids(
        pillar=np.repeat(np.moveaxis(pillars, (0, 1, 2), (2, 1, 0)), team, axis=2),
        active=np.repeat(np.asarray(tasks.pillar_active).T, team, axis=1),
        team=team,
    )
    drones = state.drones
    return Air(
        parameters,
        sensors.stack(noises),
        arrival,
        np.asarray(drones.position, float).reshape(count, 3).T,
        np.asarray(drones.quaternion, float).reshape(count, 4).T,
        partners=[np.roll(index, -shift, axis=1).ravel() for shift in range(1, team)],
        solids=solids,
    )

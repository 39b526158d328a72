"""The policy's episodes in each of the three worlds."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.worlds.game import play
from experiments.worlds.plant import PlantWorld
from openjax.pursuit import Pursuit, PursuitSettings, uniform_task
from openjax.pursuit.reward import captures
from openjax.pursuit.sensing import line_of_sight

FIGURES = ("captured", "capture_step", "collision_rate", "crashed")
CLOSE = 0.5  # of the capture radius: the whole one is reached in nearly every episode, so it says little
TASK_KEY = 7_000_001  # tasks and start attitudes are the same in all worlds


def draw_tasks(settings: PursuitSettings, start: int, number: int):
    """Tasks number `start` to `start + number` of the uniform draw, and their reset keys."""
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(TASK_KEY)))(jnp.arange(start, start + number))
    pairs = jax.vmap(jax.random.split)(keys)
    return jax.vmap(partial(uniform_task, settings))(pairs[:, 0]), pairs[:, 1]


def catches_closely(settings: PursuitSettings, state) -> jax.Array:
    """Whether some pursuer of a world catches the evader within half of the capture radius now. () bool.

    The policy doesn't know the capture radius, so this is the game with the smaller one.
    """
    smaller = dataclasses.replace(settings, capture_radius=CLOSE * settings.capture_radius)

    task = state.task
    sight = line_of_sight(
        settings, state.drones.position, state.evader_position, task.pillar_position, task.pillar_active
    )
    return jnp.any(captures(smaller, state.drones.position, state.evader_position, sight))


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
            return (observation, state, closely | jax.vmap(partial(catches_closely, settings))(state)), None

        carry = (*jax.vmap(environment.reset_to)(keys, tasks), jnp.zeros(number, bool))
        (_, state, closely), _ = jax.lax.scan(one, carry, None, length=settings.episode_length)
        return state.statistics, closely

    return figures_of(*jax.jit(episodes)(loaded.parameters, tasks, keys, parameters or {}))


def fly_plant(loaded, settings, start, number, case) -> dict[str, list[float]]:
    """Episodes in the exam's plant with the causes of `case`; `flights.Case` says which vehicle flies."""
    tasks, keys = draw_tasks(settings, start, number)

    def make_world(drones, tasks):
        ticks = settings.episode_length
        return PlantWorld(drones, tasks, ticks, case.seed, case.number, case.cause, first=start)

    def watch(state, action):
        del action
        return catches_closely(settings, state)

    statistics, closely = play(loaded, settings, tasks, keys, make_world, watch)
    return figures_of(statistics, np.any(closely, axis=0))

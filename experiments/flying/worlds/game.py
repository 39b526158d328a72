"""The game around vehicles that fly elsewhere.

It is `openjax.pursuit`'s own, without its physics.
"""

import functools
from collections.abc import Callable

import jax
import numpy as np

from experiments.flying.worlds.world import World
from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitSettings, Task, action_to_command
from openjax.vehicle import DroneState


class SeenElsewhere:
    """Stands in for a drones' step: what is seen of the drones lies in their memory."""

    def reset(self, vehicle, drones: DroneState, key=None) -> DroneState:
        """Drones that are seen where they are."""
        del vehicle, key
        seen = {name: getattr(drones, name) for name in ("position", "quaternion", "velocity")}
        return drones.replace(effect_memory=seen)

    def seen(self, drones: DroneState, effect_parameters=None) -> DroneState:
        """The drones as they were measured."""
        del effect_parameters
        return drones.replace(**drones.effect_memory)


def play(
    loaded,
    settings: PursuitSettings,
    tasks: Task,
    keys: jax.Array,
    make_world: Callable[[DroneState, Task], World],
) -> EpisodeStatistics:
    """Episodes (W,) of a policy's mean in a world.

    Args:
      loaded: from `openjax.load_policy`.
      settings: the game.
      tasks: leading axis W.
      keys: (W,) draw the start attitudes.
      make_world: of the drones (W, N, ...) at the start and the tasks.
    """
    reset, look, act, advance = _compiled(settings, loaded.policy)
    state = reset(keys, tasks)
    world = make_world(state.drones, tasks)
    observation = look(state, world.measure())
    for _ in range(settings.episode_length):
        action, command = act(loaded.parameters, observation)
        world.fly(np.asarray(command, float))
        observation, state = advance(state, action, world.poses(), world.measure())
    return state.statistics


@functools.cache
def _compiled(settings, policy):
    """The game's start, its observation of measured poses, the policy, and the game's step with poses from outside."""
    game = Pursuit(settings, dynamics=SeenElsewhere())

    def observe(state, seen):
        return game.observe(state.replace(drones=state.drones.replace(effect_memory=seen)))

    def act(weights, observation):
        action = policy.act(weights, observation)
        return action, action_to_command(action)

    def advance(state, action, flown, seen):
        drones = state.drones.replace(**flown, effect_memory=seen)
        return game.follow(state, action, drones)[:2]

    return (
        jax.jit(jax.vmap(lambda key, task: game.reset_to(key, task)[1])),
        jax.jit(jax.vmap(observe)),
        jax.jit(act),
        jax.jit(jax.vmap(advance)),
    )

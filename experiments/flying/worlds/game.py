"""What a world is: it flies bodies by commands, and says where they are and where they
are seen. And the game around it, which is `openjax.pursuit`'s own, without its physics.
"""

import functools
from collections.abc import Callable
from typing import Protocol

import jax
import numpy as np

from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitSettings, Task, action_to_command
from openjax.vehicle import DroneState

Poses = dict[str, np.ndarray]
"""position (W, N, 3) m, quaternion (W, N, 4) wxyz, velocity (W, N, 3) m/s of N pursuers
in W worlds, float32.
"""


class World(Protocol):
    """W worlds with N vehicles each, at the start of their episodes. A tick is a
    control step, 10 ms.
    """

    def poses(self) -> Poses:
        """Where the vehicles are."""

    def measure(self) -> Poses:
        """Where the vehicles are seen at this tick: late, noisy, as the world has
        it.
        """

    def fly(self, command: np.ndarray) -> None:
        """One tick after sending `command` (W, N, 4): collective thrust in 0..1, body
        rates in rad/s.
        """


def per_world(team: int, position, quaternion, velocity) -> Poses:
    """Poses of bodies in the last axis, (3, W * N) and so on, as `Poses`."""
    parts = {"position": position, "quaternion": quaternion, "velocity": velocity}
    return {
        n: np.asarray(x).T.reshape(-1, team, len(x)).astype(np.float32) for n, x in parts.items()
    }


class SeenElsewhere:
    """Stands in for a drones' step: what is seen of the drones lies in their memory."""

    def reset(self, vehicle, drones: DroneState, key=None) -> DroneState:
        """Drones that are seen where they are."""
        shown = {name: getattr(drones, name) for name in ("position", "quaternion", "velocity")}
        return drones.replace(effect_memory=shown)

    def seen(self, drones: DroneState, effect_parameters=None) -> DroneState:
        """The drones as they were measured."""
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
    """The game's start, its observation of measured poses, the policy, and the game's
    step with poses from outside.
    """
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

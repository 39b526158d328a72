"""A learner's evader as one of the game's, to watch it or to fly against it."""

from typing import Any

import jax
import jax.numpy as jnp

from openjax.evaluation.judges.networks import apply_network
from openjax.evaluation.judges.senses import sense, to_world
from openjax.pursuit.evaders import MEMORY, EvaderKind


def opponent(actor: Any, world_axes: jax.Array, hold: int) -> EvaderKind:
    """The evader of one `actor`, without an axis of learners, that decides every `hold` control
    steps, () bool in the world's axes or its own.
    """
    network = jax.tree.map(lambda leaf: leaf[None], actor)

    def velocity(scene, memory):
        world = scene.world
        sensed = sense(scene.settings, world, world_axes)
        decided = to_world(apply_network(network, sensed[None, None])[0, 0], world, world_axes)
        decided = jnp.where(world.step % hold == 0, decided, memory[MEMORY:])
        return scene.reach * decided, memory.at[MEMORY:].set(decided)

    return EvaderKind(velocity, of="file", memory=MEMORY + 3)

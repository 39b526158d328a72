"""A learner's evader as one of the game's, to watch it or to fly against it."""

from typing import Any

import jax
import jax.numpy as jnp

from openjax.evaluation.judges.networks import apply_network, likeliest
from openjax.evaluation.judges.senses import sense, to_world
from openjax.pursuit.evaders.kinds import MEMORY, EvaderKind


def opponent(actor: Any, world_axes: jax.Array, hold: int, slots: int) -> EvaderKind:
    """The evader of one actor.

    Args:
      actor: parameters, without an axis of learners.
      world_axes: () bool, whether it sees in the world's axes.
      hold: control steps for which it flies a decision.
      slots: of pillars that it senses.
    """
    network = jax.tree.map(lambda leaf: leaf[None], actor)

    def velocity(scene, memory):
        world = scene.world
        senses = sense(scene.settings, world, world_axes, slots)
        decision = likeliest(apply_network(network, senses[None, None]))[0, 0]
        decision = to_world(decision, world, world_axes)
        decision = jnp.where(world.step % hold == 0, decision, memory[MEMORY:])
        return scene.reach * decision, memory.at[MEMORY:].set(decision)

    return EvaderKind(velocity, of="file", memory=MEMORY + 3)

"""A network that says where to fly, and a controller that flies there: the easier half
of the paper's task.

The paper's policies command thrust and body rates, so they must learn to stay in the
air before they can learn to chase. Here a sample is a velocity, which the baselines'
velocity controller flies.
"""

import dataclasses

import jax
import jax.numpy as jnp

from openjax.baselines.craft_policy import CraftPolicy
from openjax.baselines.surroundings import length
from openjax.baselines.velocity_controller import velocity_action
from openjax.pursuit import Observation


@dataclasses.dataclass(frozen=True)
class VelocityPolicy(CraftPolicy):
    """A policy whose samples are velocities instead of commands."""

    NAME = "output velocity"

    @staticmethod
    def start() -> tuple[float, ...]:
        """Standing still."""
        return 0.0, 0.0, 0.0

    def action(self, sample: jax.Array, observation: Observation) -> jax.Array:
        """The action (..., N, 4) in -1..1 of a sample (..., N, 3) of the Gaussian,
        or of its mean.
        """
        velocity = self.craft.speed * super().action(sample, observation)
        # components in -1..1 make a cube: its corners are cut to the largest speed
        velocity = velocity / jnp.maximum(length(velocity) / self.craft.speed, 1.0)
        return velocity_action(self.craft, observation, velocity)

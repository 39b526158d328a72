"""A network that says where to fly, and a controller that flies there: the easier half of the paper's task.

The paper's policies command thrust and body rates, so they must learn to stay in the air before they can learn to chase.
Here a sample is a velocity, which the baselines' velocity controller flies.
"""

import dataclasses

import jax
import jax.numpy as jnp

from openjax.baselines.surroundings import Craft, length
from openjax.baselines.velocity_controller import check_flyable, velocity_action
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Observation, Pursuit


@dataclasses.dataclass(frozen=True)
class VelocityPolicy(Policy):
    """A policy whose samples are velocities instead of commands."""

    craft: Craft = dataclasses.field(default_factory=Craft)

    @classmethod
    def for_environment(
        cls, environment: Pursuit, network: NetworkSettings, predictor: PredictorSettings
    ) -> "VelocityPolicy":
        """The policy for an environment; its mean starts at standing still.

        Raises:
            UserError: the velocity controller can't fly there.
        """
        craft = Craft.of(environment)
        check_flyable("output velocity", craft, environment.settings.time_step)
        return cls(
            network=network,
            predictor=predictor,
            arena_radius=environment.settings.arena_radius,
            arena_height=environment.settings.arena_height,
            initial_action=(0.0, 0.0, 0.0),
            craft=craft,
        )

    def action(self, sample: jax.Array, observation: Observation) -> jax.Array:
        """The action (..., N, 4) in -1..1 that a sample (..., N, 3) of the Gaussian, or its mean, stands for."""
        velocity = self.craft.speed * super().action(sample, observation)
        velocity = velocity / jnp.maximum(length(velocity) / self.craft.speed, 1.0)
        return velocity_action(self.craft, observation, velocity)

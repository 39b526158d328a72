"""Pursuers that are points, of whom theorems speak, and how they fly: games whose
answer is known, and what a vehicle's inertia costs beside them.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from openjax.baselines.stack import StackParameters, stack
from openjax.baselines.surroundings import Craft, length, surroundings
from openjax.pursuit import Observation, Pursuit, PursuitSettings
from openjax.vehicle import DroneState


@dataclasses.dataclass(frozen=True)
class Points:
    """Dynamics in which pursuers are points: the last three numbers of an action are a
    velocity, as shares of `speed` (m/s).
    """

    speed: float
    time_step: float

    def reset(self, vehicle, drones: DroneState, key=None) -> DroneState:
        """They start where they are."""
        return drones

    def __call__(self, vehicle, drones: DroneState, command: jax.Array, *_) -> DroneState:
        """The points a step later; nothing is solid to them."""
        share = command[:, 1:] / jnp.pi
        velocity = self.speed * share / jnp.maximum(length(share), 1.0)
        return drones.replace(
            velocity=velocity, position=drones.position + self.time_step * velocity
        )

    def seen(self, drones: DroneState, effect_parameters=None) -> DroneState:
        """They know where they are."""
        return drones


def game_of_points(**changes) -> Pursuit:
    """A game of points in an arena without pillars, if its tasks have none."""
    defaults = {"physics": "stops", "speed_limit": "none", "min_pillars": 0, "max_pillars": 1}
    settings = PursuitSettings(**(defaults | changes))
    return Pursuit(settings, dynamics=Points(settings.max_speed, settings.time_step))


@dataclasses.dataclass(frozen=True)
class Team:
    """A policy for `Points`, by a function from observations to velocities (..., N, 3)
    as shares of the speed.
    """

    velocity: Callable[[Observation], jax.Array]

    def act(self, parameters, observation: Observation) -> jax.Array:
        """(..., N, 4): no thrust, a velocity."""
        velocity = self.velocity(observation)
        return jnp.concatenate([jnp.zeros_like(velocity[..., :1]), velocity], axis=-1)


def stack_team(environment: Pursuit) -> Team:
    """Stack, by points that correct themselves within a step."""
    settings = environment.settings
    craft = dataclasses.replace(Craft.of(environment), speed=settings.max_speed, response=0.0)
    # a gain of one over the step: what is amiss is gone at the next one
    parameters = StackParameters(tolerance=0.05, gain=1.0 / settings.time_step)
    return Team(
        lambda observation: (
            stack(craft, parameters, surroundings(craft, observation)) / settings.max_speed
        )
    )

"""The game in which a policy is adapted to one vehicle, and the policy that begins in
it.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from openjax.learning.settings import TrainSettings
from openjax.policy import PolicyParameters
from openjax.policy.growth import in_larger_game
from openjax.pursuit import PursuitSettings, RewardSettings
from openjax.vehicle.family import REST, adapted_family, family_bounds
from openjax.vehicle.parameters import NOMINAL

RATE_LOOP = 0.002
"""Period of a Crazyflie's rate loop (s)."""
HISTORY = 12
"""Frames of its own flight that an adapted policy sees at least: with late commands and
slow motors one isn't enough.
"""


def adapting_game(game: PursuitSettings) -> PursuitSettings:
    """The game as vehicles fly it, whatever a policy was trained in: no clamp, the rate
    loop at 500 Hz, solid pillars.
    """
    return dataclasses.replace(
        game,
        vehicles=adapted_family({}, {}, airframe=game.airframe),
        rare_vehicles=0.0,
        observe_history=max(game.observe_history, HISTORY),
        speed_limit="none",
        physics="stops",
        substeps=max(game.substeps, round(game.time_step / RATE_LOOP)),
        start_attitude="drawn",
        reward=RewardSettings(),
    )


def starting_parameters(parameters: PolicyParameters, settings: TrainSettings) -> PolicyParameters:
    """A policy as it begins in `adapting_game`, without its critic; it acts as
    before.
    """
    game = settings.environment

    def longer(one):
        return in_larger_game(one, settings.predictor, game, adapting_game(game))

    start = parameters.replace(critic={})
    # the members of a team that draws stand side by side
    start = longer(start) if game.strategies == 1 else jax.vmap(longer)(start)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start)


def bounds_of(
    values, intervals, rest: float = REST, airframe: str = NOMINAL
) -> Float[Array, "ranges 4"]:
    """(R, 4) bounds of the family of a diagnosed vehicle; see `adapted_family`. Of
    nothing found and no rest: nominal.
    """
    return jnp.asarray(family_bounds(adapted_family(values, intervals, rest, airframe)))

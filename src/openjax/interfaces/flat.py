"""Observations as flat vectors, for libraries that want arrays instead of
structures.
"""

import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.pursuit import Observation, Pursuit, PursuitSettings, make
from openjax.pursuit.axes import turned_back

ACTION_SIZE = 4
"""Collective thrust, roll, pitch and yaw rate, each in -1..1."""


def game_of(environment: Pursuit | None, changes: dict) -> Pursuit:
    """The game that an interface was asked for: `environment`, or the nominal one with
    some settings changed.

    Raises:
      UserError: both are given, or there is no such setting.
    """
    if environment is not None and changes:
        raise UserError(
            f"{', '.join(changes)} beside an environment: give settings to the environment instead"
        )
    return environment or make(**changes)


def flat_size(settings: PursuitSettings) -> int:
    """Numbers that one pursuer observes in `flat_observation`."""
    others = (settings.num_pursuers - 1) * 3
    return settings.self_size + others + settings.observed_pillars * 5 + 3


def flat_observation(observation: Observation) -> jax.Array:
    """(..., N, D) what each of N pursuers observes, in one vector.

    In this order: its own state (see `Observation.self_state`), the other pursuers, the
    nearest pillars, and its position relative to where the evader was last seen (m).
    What isn't seen is -5.
    """
    # the axes of worlds and pursuers stay; what each sees of others and pillars becomes
    # one row
    lead = observation.self_state.shape[:-1]
    parts = (
        observation.self_state,
        observation.others.reshape(*lead, -1),
        observation.pillars.reshape(*lead, -1),
        turned_back(
            observation.heading, observation.position - observation.last_seen[..., None, :]
        ),
    )
    return jnp.concatenate(parts, axis=-1)


def to_numpy(tree):
    """A tree of arrays as NumPy arrays of their own memory."""
    return jax.tree.map(np.array, tree)

"""Observations as flat vectors, for libraries that want arrays instead of
structures.
"""

import jax
import jax.numpy as jnp
import numpy as np

from openjax.pursuit import Observation, PursuitSettings
from openjax.pursuit.axes import turned_back

ACTION_SIZE = 4
"""Collective thrust, roll, pitch and yaw rate, each in -1..1."""


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

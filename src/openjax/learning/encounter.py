"""What pursuers meet while a gradient is taken: gaps, breaches, speeds, and the evader."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Encounter(NamedTuple):
    """What the pursuers of B worlds met in some steps, all smooth and (B, N) unless
    said otherwise.
    """

    least: jax.Array
    """m, least gap to anything solid"""
    upright: jax.Array
    """least cosine of the tilt"""
    breach: jax.Array
    """mean number of breaches"""
    excess: jax.Array
    """mean excess of speed, in units of `FAST`"""
    distance: jax.Array
    """(B,) m, mean length of the nearest pursuers' paths to the evader, beyond where
    they may rest
    """
    free: jax.Array
    """(B,) share of the steps in which nobody has caught the evader"""
    territory: jax.Array
    """(B,) mean share of the arena that the evader can be at before any pursuer"""
    unseen: jax.Array
    """(B,) mean of how well the evader hides from all pursuers"""


def no_encounter(shape: tuple[int, int]) -> Encounter:
    """What pursuers (B, N) have met before the first step."""
    zeros = jnp.zeros(shape)
    of_worlds = jnp.zeros(shape[0])
    return Encounter(
        least=zeros + jnp.inf,
        upright=zeros + 1.0,
        breach=zeros,
        excess=zeros,
        distance=of_worlds,
        free=of_worlds,
        territory=of_worlds,
        unseen=of_worlds,
    )

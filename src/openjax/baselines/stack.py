"""Stack: point pursuers that force a capture of a faster evader in an arena without pillars.

All N gather on the arena's axis at heights (2 i - 1) H / 2 N, keep the evader's angle about the
axis, and move outwards. The evader is never farther than H / 2 N above or below one of these
heights, so that pursuer has it within r once they are within s = sqrt(r^2 - (H / 2 N)^2) of it
along the ray. A pursuer at radius x keeps the angle of an evader at radius y if v_p y >= v_e x; the
worst is the wall, y = R, up to x = R - s. So a capture is forced within finite time if

    v_e / v_p < R / (R - sqrt(r^2 - (H / 2 N)^2)),

1.331 for three pursuers, r = .3 m, R = .9 m, H = 1.2 m. (An evader between axis and pursuer has
crossed s before.)

They can do more (`planar_bound`): while they keep its angle, the evader at the wall must run to one
side, and they dash at where it will be.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from openjax.baselines.parameters import parameter
from openjax.baselines.surroundings import Craft, Surroundings, length
from openjax.pursuit.settings import PursuitSettings

PLANAR = (
    (1.0, 1.05, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8, 2.0, 2.25, 2.5, 3.0, 3.5),
    (0.0, 0.01, 0.026, 0.065, 0.106, 0.146, 0.185, 0.221, 0.286, 0.342, 0.402, 0.453, 0.532, 0.592),
)
"""Ratios of speeds, and how near a point comes to a faster one in a disc, in radii: the game of
both solved on a grid (experiments/results/planar.md).
"""


def stack_bound(settings: PursuitSettings) -> float:
    """The ratio of speeds v_e / v_p below which stack forces a capture; 0 where a pursuer's height
    isn't covered.
    """
    half = settings.arena_height / (2 * settings.num_pursuers)
    if half >= settings.capture_radius:
        return 0.0
    across = (settings.capture_radius**2 - half**2) ** 0.5
    return settings.arena_radius / max(settings.arena_radius - across, 1e-9)


def planar_bound(settings: PursuitSettings) -> float:
    """The ratio of speeds v_e / v_p below which points that fly one above another can force a
    capture, by `PLANAR`; 0 where a pursuer's height isn't covered. How they do it isn't here.
    """
    half = settings.arena_height / (2 * settings.num_pursuers)
    if half >= settings.capture_radius:
        return 0.0
    across = (settings.capture_radius**2 - half**2) ** 0.5
    return float(np.interp(across / settings.arena_radius, *PLANAR[::-1]))


@struct.dataclass
class StackParameters:
    """How well pursuers must stand on the ray before they move outwards, and how fast they correct
    themselves.
    """

    tolerance: jax.Array = parameter(0.05, 0.005, 0.2)
    """Distance from the ray and from the own height (m)."""
    gain: jax.Array = parameter(6.0, 1.0, 100.0)
    """1/s, distance to velocity."""


def stack(craft: Craft, parameters: StackParameters, known: Surroundings) -> jax.Array:
    """Desired velocities (..., N, 3), m/s, world."""
    number = known.position.shape[-2]
    goal = craft.arena_height * (2 * jnp.arange(number) + 1.0) / (2 * number)
    height = goal - known.position[..., 2]
    target = known.target[..., :2]
    place = known.position[..., :2]
    out = target / length(target)
    aside = jnp.stack([-out[..., 1], out[..., 0]], axis=-1)
    along = jnp.sum(place * out, axis=-1)
    across = jnp.sum(place * aside, axis=-1)
    ready = (jnp.abs(height) < parameters.tolerance) & (jnp.abs(across) < parameters.tolerance)
    # all must stand before any moves: the bound holds for a whole stack only
    ready = jnp.all(ready & (along > -parameters.tolerance), axis=-1, keepdims=True)

    def cut(speed, left):
        """Velocity at most what is left of the speed, and what then is left (both (...,))."""
        speed = jnp.clip(speed, -left, left)
        return speed, jnp.sqrt(jnp.maximum(left**2 - speed**2, 0.0))

    # what keeps the ray comes first, then the height; moving outwards gets what speed is left
    left = jnp.full_like(height, craft.speed)
    aside_speed, left = cut(-parameters.gain * across, left)
    up, left = cut(parameters.gain * height, left)
    forwards = out * left[..., None] + aside * aside_speed[..., None]

    # before that each flies to its place on the axis
    gather = -parameters.gain * place
    size = jnp.sqrt(jnp.sum(gather**2, axis=-1) + (parameters.gain * height) ** 2 + 1e-12)
    gather = gather * jnp.minimum(1.0, craft.speed / size)[..., None]
    rise = parameters.gain * height * jnp.minimum(1.0, craft.speed / size)
    level = jnp.where(ready[..., None], forwards, gather)
    return jnp.concatenate([level, jnp.where(ready, up, rise)[..., None]], axis=-1)

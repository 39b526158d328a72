"""Stack: point pursuers that force a capture of a faster evader in an arena without
pillars.

All N gather on the arena's axis at heights (2 i - 1) H / 2 N, keep the evader's angle
about the axis, and move outwards. The evader is never farther than H / 2 N above or
below one of these heights, so that pursuer has it within r once they are within s =
sqrt(r^2 - (H / 2 N)^2) of it along the ray. A pursuer at radius x keeps the angle of an
evader at radius y if v_p y >= v_e x; the worst is the wall, y = R, up to x = R - s. So
a capture is forced within finite time if

    v_e / v_p < R / (R - sqrt(r^2 - (H / 2 N)^2)),

1.331 for three pursuers, r = .3 m, R = .9 m, H = 1.2 m. (An evader between axis and
pursuer has crossed s before.)

They can do more (`planar_bound`): while they keep its angle, the evader at the wall
must run to one side, and they dash at where it will be.
"""

import math

import jax
import jax.numpy as jnp
from flax import struct

from openjax.baselines.parameters import parameter
from openjax.baselines.surroundings import Craft, Surroundings, length
from openjax.pursuit.settings import PursuitSettings

LARGEST = 1000.0
"""Ratio of speeds above which nobody looks."""


def stack_bound(settings: PursuitSettings) -> float:
    """The ratio of speeds v_e / v_p below which stack forces a capture; 0 where a
    pursuer's height isn't covered.
    """
    across = column_reach(settings)
    if not across:
        return 0.0
    return settings.arena_radius / max(settings.arena_radius - across, 1e-9)


def column_reach(settings: PursuitSettings) -> float:
    """Horizontal reach (m) of points that fly one above another and cover the whole height; 0 if
    they don't cover it.
    """
    half = settings.arena_height / (2 * settings.num_pursuers)
    square = settings.capture_radius**2 - half**2
    # six of .1 m cover 1.2 m, but for an evader midway between two, which is at the
    # radius itself; a rounding error isn't a reach
    return square**0.5 if square > 1e-9 else 0.0


def planar_bound(settings: PursuitSettings) -> float:
    """The ratio of speeds v = v_e / v_p below which points that fly one above another
    capture; 0 where a pursuer's height isn't covered, at most `LARGEST`. How they do it
    isn't here.

    Up to the radius R / v they keep the evader's angle. From there it must run one way
    round the wall, and they dash straight on, across the ray. They are nearest when it
    has come to the angle a with cos a = 1 / v, at R (sin a - a / v); so leaves the lady
    in the lake (Isaacs, 1965), who flees from the one that runs round. They capture if

        sqrt(1 - 1 / v^2) - arccos(1 / v) / v < s / R.

    It isn't proved that neither side does better; the game of both points solved on
    grids says the same within their errors (docs/what_can_be_caught.md).
    """
    reach = column_reach(settings) / settings.arena_radius
    if not reach:
        return 0.0
    low = 1.0
    high = LARGEST
    while high - low > 1e-9:
        middle = (low + high) / 2.0
        if nearest_in_disc(middle) < reach:
            low = middle
        else:
            high = middle
    return low


def nearest_in_disc(ratio: float) -> float:
    """The distance to which a point can approach one that is `ratio` > 1 times as fast in a disc,
    in radii; see `planar_bound`.
    """
    return math.sqrt(1.0 - ratio**-2) - math.acos(1.0 / ratio) / ratio


@struct.dataclass
class StackParameters:
    """Limits of when pursuers on the ray move outwards, and gains by which they
    correct themselves.
    """

    tolerance: jax.Array = parameter(0.05, 0.005, 0.2)
    """Distance from the ray and from the own height (m)."""
    gain: jax.Array = parameter(6.0, 1.0, 100.0)
    """1/s, distance to velocity."""


def stack(craft: Craft, parameters: StackParameters, around: Surroundings) -> jax.Array:
    """Desired velocities (..., N, 3), m/s, world."""
    number = around.position.shape[-2]
    goal = craft.arena_height * (2 * jnp.arange(number) + 1.0) / (2 * number)
    height = goal - around.position[..., 2]
    target = around.target[..., :2]
    place = around.position[..., :2]
    out = target / length(target)
    aside = jnp.stack([-out[..., 1], out[..., 0]], axis=-1)
    along = jnp.sum(place * out, axis=-1)
    across = jnp.sum(place * aside, axis=-1)
    ready = (jnp.abs(height) < parameters.tolerance) & (jnp.abs(across) < parameters.tolerance)
    # all must stand before any moves: the bound holds for a whole stack only
    ready = jnp.all(ready & (along > -parameters.tolerance), axis=-1, keepdims=True)

    def cut(speed, rest):
        """Velocity at most what is left of the speed, and what then is left (both
        (...,)).
        """
        speed = jnp.clip(speed, -rest, rest)
        return speed, jnp.sqrt(jnp.maximum(rest**2 - speed**2, 0.0))

    # what keeps the ray comes first, then the height; moving outwards gets what speed
    # is left
    speed_left = jnp.full_like(height, craft.speed)
    aside_speed, speed_left = cut(-parameters.gain * across, speed_left)
    up, speed_left = cut(parameters.gain * height, speed_left)
    forwards = out * speed_left[..., None] + aside * aside_speed[..., None]

    # before that each flies to its place on the axis
    gather = -parameters.gain * place
    size = jnp.sqrt(jnp.sum(gather**2, axis=-1) + (parameters.gain * height) ** 2 + 1e-12)
    gather = gather * jnp.minimum(1.0, craft.speed / size)[..., None]
    rise = parameters.gain * height * jnp.minimum(1.0, craft.speed / size)
    level = jnp.where(ready[..., None], forwards, gather)
    return jnp.concatenate([level, jnp.where(ready, up, rise)[..., None]], axis=-1)

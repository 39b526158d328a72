"""Conventions of other programs in which a whole log, or its attitude, may be written:
what the channels would be in the log format's, and what to do about it, in words.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from openjax.flights.pairs import Signals
from openjax.flights.track import rotation

RECIPE = "the recipe is on the page of the log format, under Rows in NED"
# Both turn back what they turn: half a turn about x, and about the line between north and east.
DOWN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
NORTH = Rotation.from_quat([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])


@dataclass(frozen=True)
class Convention:
    """A way to write a log that isn't the log format's."""

    words: str
    """The mistake, and what would be right."""
    convert: Callable[[Signals], Signals]
    """The signals as they are in the log format's convention, if they were logged in this one."""


def upright(signals: Signals) -> bool:
    """True if the body's z is up most of the time, as in a flight; a comparison in a band of
    frequencies can't detect a world that is upside down.
    """
    if signals.quaternion is None:
        return True
    return bool(np.median(rotation(signals.quaternion)[:, 2, 2]) > 0.0)


def other_pitch(signals: Signals) -> Signals:
    """With pitch and the gyroscope's rate about y the other way round."""
    changes = {}
    if signals.quaternion is not None:
        attitude = Rotation.from_quat(signals.quaternion, scalar_first=True)
        angles = attitude.as_euler("ZYX") * [1.0, -1.0, 1.0]
        changes["quaternion"] = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    if signals.body_rates is not None:
        changes["body_rates"] = signals.body_rates * [1.0, -1.0, 1.0]
    return dataclasses.replace(signals, **changes)


def rotate(signals: Signals, world: Rotation | None, body: Rotation | None) -> Signals:
    """With the world's and the body's axes turned, those of every channel that is in them."""
    changes = {}
    for names, turn in (
        (("position", "velocity"), world),
        (("body_rates", "force", "commands"), body),
    ):
        for name in names:
            if turn is not None and getattr(signals, name) is not None:
                changes[name] = turn.apply(getattr(signals, name))
    if signals.quaternion is not None:
        attitude = Rotation.from_quat(signals.quaternion, scalar_first=True)
        attitude = attitude if world is None else world * attitude
        attitude = attitude if body is None else attitude * body
        changes["quaternion"] = attitude.as_quat(scalar_first=True)
    return dataclasses.replace(signals, **changes)


BODY = Convention(
    f"the body's axes are forward, right, down (FRD), not forward, left, up: {RECIPE}",
    lambda signals: rotate(signals, None, DOWN),
)
FRAMES = (
    Convention(
        "the rows are in north, east, down and forward, right, down (NED, FRD), not in east, "
        f"north, up and forward, left, up: {RECIPE}",
        lambda signals: rotate(signals, NORTH, DOWN),
    ),
    BODY,
    Convention(
        f"the world's axes are north, east, down (NED), not east, north, up: {RECIPE}",
        lambda signals: rotate(signals, NORTH, None),
    ),
)
"""Axes of world and body, the likeliest first."""
LEGACY = Convention(
    "pitch and wy have the other sign, the Crazyflie firmware's legacy sense: scale = -1 for pitch "
    "and wy in columns.toml",
    other_pitch,
)
CONVENTIONS = (*FRAMES, LEGACY)
"""All that may be what a log's channels disagree by."""

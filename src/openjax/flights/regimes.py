"""Parts of a flight by what the vehicle does: where it is, how fast, how hard its motors work."""

import numpy as np

from openjax.flights.shapes import Chosen
from openjax.flights.track import Track, smooth
from openjax.vehicle.effects.effect import ARENA_CEILING

NEAR_CEILING = 0.15  # m, as near as `low` is to the floor
REGIMES = (
    "hover",
    "fast",
    "climb",
    "low",
    "high",
    "under_neighbour",
    "low_battery",
    "high_thrust",
    "transient",
)


def regimes_of(track: Track) -> dict[str, Chosen]:
    """Masks (T,) of the regimes; a row may be in several."""
    rows = len(track)
    nowhere = np.zeros(rows, bool)
    collective = smooth(track.motor.mean(1), 0.05, track.dt)
    change = np.abs(np.gradient(smooth(track.motor, 0.03, track.dt), track.dt, axis=0)).max(1)
    masks = {r: nowhere for r in REGIMES}
    masks["high_thrust"] = track.motor.max(1) > 0.8
    masks["transient"] = change > max(1.0, float(np.quantile(change, 0.8)))
    if track.velocity is not None:
        speed = np.linalg.norm(track.velocity[:, :2], axis=1)
        masks["hover"] = (speed < 0.3) & (np.abs(track.velocity[:, 2]) < 0.2)
        masks["fast"] = speed > 0.7
        masks["climb"] = np.abs(track.velocity[:, 2]) > 0.3
    if track.position is not None:
        masks["low"] = track.position[:, 2] < 0.15
        ceiling = ARENA_CEILING if track.ceiling is None else track.ceiling
        masks["high"] = track.position[:, 2] > ceiling - NEAR_CEILING
        for other in track.neighbours:
            gap = other - track.position
            is_below = (gap[:, 2] > 0.05) & (np.hypot(gap[:, 0], gap[:, 1]) < 0.2)
            masks["under_neighbour"] = masks["under_neighbour"] | is_below
    if track.voltage is not None:
        masks["low_battery"] = track.voltage < 3.5
    masks["high_thrust"] = masks["high_thrust"] | (collective > 0.8)
    return masks

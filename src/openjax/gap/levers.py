"""Torques that no push could make: what turns a vehicle without moving it.

Turbulence pushes, and turns by what it pushes: its torque is its force at a short lever, and no lever is longer than an arm.
What turns the vehicle and hardly pushes it is no gust. Nor is it what the model has wrong, which is largest where motors
turn the vehicle most: a disturbance is met by motors that answer it, so that the vehicle hardly turns though they work (a slow
one), or turns though they don't yet (a quick one). So of the rest only what goes beyond the smaller of both counts. No
form, frequency or place is asked for."""

from __future__ import annotations

import numpy as np

from openjax.flights.track import Track
from openjax.gap.replay import FORCE, RATES, SKIP, VELOCITY

WIDTH = 0.1  # s of the means: shorter ones are the gyroscope's noise
WRONG = 0.5  # of what motors do that a model may have wrong
LEVER = 0.025  # m: half an arm
TURNING = 2.0  # times the lever about x and y, that one about z must have: gusts turn more about these
SHORT = 0.008  # m: the least lever of such a one
# Times as long where clocks drift or it isn't known what motors do within a row; z has no lever of its own then.
BLIND = 2.0
STILL = 0.03  # m/s^2 of push below which sensors can't tell one
FEWEST = 10  # means of a track
TURN = 0.7  # rad/s^2: less doesn't matter


def levers(
    tracks: list[Track], disturbed: list[np.ndarray], turned: list[np.ndarray], usable: np.ndarray, vehicles
) -> tuple[np.ndarray, np.ndarray] | None:
    """Levers (3,) m about each axis, and torques (3,) rad/s^2 of which they are; None where the log doesn't tell them.

    disturbed [(T, 9)]: what is left as accelerations, see `rest.disturbances`, with what feedback made of it; turned [(T, 3)]:
    angular acceleration as measured; usable (9,)."""
    sensors = [axes for axes in (VELOCITY, FORCE) if usable[axes].min() > 0.0]
    if usable[RATES].min() <= 0.0 or not sensors or not all(t.motors_logged for t in tracks):
        return None
    torque, noise, push, count = np.zeros(3), np.zeros(3), np.zeros(len(sensors)), 0
    for track, d, a in zip(tracks, disturbed, turned, strict=True):
        size = max(round(WIDTH / track.dt), 1)
        inside = slice(int(2 * SKIP / track.dt), len(d) - max(int(SKIP / 2 / track.dt), 1))
        left, whole = _means(d[inside, RATES], size), _means(a[inside], size)
        # What motors did in rows that are missing isn't known.
        gaps = np.zeros(len(d)) if track.missing is None else track.missing.astype(float)
        known = _around(_means(gaps[inside, None], size), (-1, 0, 1))[:, 0] == 0.0
        if known.sum() < FEWEST:
            continue
        left = left - left[known].mean(0)
        # Late motors are wrong by what they did before.
        worked = np.minimum(_around(whole, (-1, 0, 1)), _around(whole - left, (0, 1)))
        torque += (np.maximum(np.abs(left) - WRONG * worked, 0.0)[known] ** 2).sum(0)
        count += int(known.sum())
        # White noise of the gyroscope: three differences leave little else. A central one came before.
        rough = (np.diff(np.cumsum(d[inside, RATES], 0) * track.dt, 3, axis=0) ** 2).mean(0) / 2.5
        noise += known.sum() * rough / (size * track.dt) ** 2
        for k, axes in enumerate(sensors):
            force = _means(d[inside, axes], size)[known]
            push[k] += ((force - force.mean(0)) ** 2).mean(1).sum()
    if not count:
        return None
    torque = np.sqrt(np.maximum(torque - noise, 0.0) / count)
    pushed = max(float(np.sqrt(push.min() / count)), STILL)
    inertia, mass = (
        np.mean([np.asarray(getattr(v, n), float) for v in vehicles], 0) for n in ("inertia", "mass")
    )
    return torque * inertia / (mass * pushed), torque


def torques(tracks, disturbed, turned, usable, vehicles, blind: bool = False) -> tuple[str, ...]:
    """Findings in words; arguments as of `levers`. `blind`: what motors do within a row isn't known."""
    found = levers(tracks, disturbed, turned, usable, vehicles)
    if found is None:
        return ()
    lever, torque = found
    long = lever > LEVER * (BLIND if blind else 1.0)
    long[2] |= not blind and lever[2] > max(TURNING * lever[:2].max(), SHORT)
    long &= torque > TURN
    if not long.any():
        return ()
    axis = int(np.argmax(np.where(long, torque, 0.0)))
    return (
        f"torques about {'xyz'[axis]} of {torque[axis]:.1f} rad/s^2 beyond what motors have wrong, where pushes are so small "
        f"that they would need a lever of {100 * lever[axis]:.0f} cm",
    )


def _around(values: np.ndarray, shifts) -> np.ndarray:
    """The largest size (N, C) of values (N, C) and those some rows before."""
    return np.max([np.abs(np.roll(values, k, 0)) for k in shifts], axis=0)


def _means(values: np.ndarray, size: int) -> np.ndarray:
    """Means (N, C) of values (T, C) over `size` rows."""
    count = len(values) // size
    return values[: count * size].reshape(count, size, -1).mean(1)

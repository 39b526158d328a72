"""Reference trajectories of the exam's plants: what the off-board controller is asked to fly.

A mission is sampled at 100 Hz. Positions are drawn as way-points or closed curves and smoothed with
a Gaussian, whose derivatives give the velocity and acceleration that the controller feeds forward.
All missions stay inside the arena (radius 0.9 m, height 1.2 m).
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d

RATE = 100.0
PAIR = ("pass", "pass_moving")


def _held(rng, knots, length, spacing):
    """Way-points (n, d) held for a random spacing each, as a (length, d) staircase."""
    out = np.empty((length, knots.shape[1]))
    start = 0
    index = 0
    while start < length:
        stop = start + max(10, int(RATE * rng.uniform(*spacing)))
        out[start:stop] = knots[index % len(knots)]
        start = stop
        index = index + 1
    return out


def _curve(rng, t, speed, radius):
    """Ellipse or figure of eight in the plane, at about `speed` (m/s), fading in over 1.5 s."""
    rate = speed / radius * rng.choice([-1.0, 1.0])
    phase = rate * t * np.clip(t / 3.0, 0.5, 1.0)
    fade = np.clip(t / 1.5, 0.0, 1.0)
    ratio = rng.uniform(0.6, 1.0)
    if rng.random() < 0.5:
        x = np.cos(phase)
        y = ratio * np.sin(phase)
    else:
        x = np.sin(phase / 1.3)
        y = ratio * np.sin(2 * phase / 1.3) / 1.4
    angle = rng.uniform(0, 2 * np.pi)
    c = np.cos(angle)
    s = np.sin(angle)
    return radius * fade[:, None] * np.stack([c * x - s * y, s * x + c * y], axis=1)


def _doublets(rng, length, rate, axes, size):
    """Short alternating pulses (K, 4) on [thrust, wx, wy, wz]; they excite what tracking alone does
    not.
    """
    pulses = np.zeros((length, 4))
    start = 100
    while start < length - 40:
        axis = rng.choice(axes)
        amplitude = rng.uniform(0.4, 1.0) * rng.choice([-1, 1]) * (0.1 if axis == 0 else size)
        width = rng.integers(4, 9)
        pulses[start : start + width, axis] += amplitude
        pulses[start + width : start + 2 * width, axis] -= amplitude
        start += int(RATE * rng.uniform(0.5, 1.5) / rate)
    return pulses


def _dither(rng, length):
    """Pseudo-random body-rate commands (K, 4) on top of tracking: a broad excitation, as
    identification flights have.
    """
    held = _held(rng, rng.choice([-1.0, 0.0, 1.0], (length, 3)), length, (0.04, 0.16))
    return np.concatenate([np.zeros((length, 1)), rng.uniform(0.2, 0.7) * held], axis=1)


def single(kind, rng, length):
    """One vehicle's reference: position (K, 3) m, velocity, acceleration, yaw (K,) rad, yaw rate,
    pulses (K, 4).
    """
    t = np.arange(length) / RATE
    position = np.zeros((length, 3))
    centre = np.r_[rng.uniform(-0.15, 0.15, 2), rng.uniform(0.45, 0.75)]
    position[:] = centre
    yaw = np.full(length, rng.uniform(-np.pi, np.pi) if rng.random() < 0.6 else 0.0)
    yaw_rate_of = rng.choice([0.0, 0.0, 0.4, -0.4, 0.8])
    pulses = np.zeros((length, 4))
    sigma = 0.18
    if kind == "hover":
        yaw_rate_of = 0.0
        sigma = 0.4
    elif kind == "agile":
        knots = np.c_[rng.uniform(-0.42, 0.42, (24, 2)), rng.uniform(0.35, 0.9, 24)]
        position = _held(rng, knots, length, (0.6, 1.1))
        sigma = 0.15
        pulses = _doublets(rng, length, 1.3, [0, 1, 2, 3], 2.0)
    elif kind == "fast":
        position[:, :2] = _curve(rng, t, rng.uniform(1.2, 1.9), rng.uniform(0.5, 0.7))
        position[:, 2] += rng.uniform(0, 0.12) * np.sin(rng.uniform(0.8, 2.0) * t)
    elif kind == "climb":
        heights = np.where(
            np.arange(30) % 2 == 0, rng.uniform(0.2, 0.45, 30), rng.uniform(0.75, 1.0, 30)
        )
        position[:, 2] = _held(rng, heights[:, None], length, (0.7, 1.3))[:, 0]
        sigma = rng.uniform(0.09, 0.14)
        pulses = _doublets(rng, length, 0.7, [0], 1.0)
    elif kind in ("low", "high"):
        bounds = (0.045, 0.22) if kind == "low" else (0.98, 1.15)
        position[:, :2] = _curve(rng, t, rng.uniform(0.3, 0.7), rng.uniform(0.25, 0.45))
        position[:, 2] = _held(rng, rng.uniform(*bounds, (40, 1)), length, (0.5, 1.4))[:, 0]
        start = np.clip(t / 2.0, 0, 1)
        position[:, 2] = (1 - start) * (0.35 if kind == "low" else 0.9) + start * position[:, 2]
        sigma = 0.16
    elif kind == "yaw":
        knots = np.c_[rng.uniform(-0.35, 0.35, (24, 2)), rng.uniform(0.4, 0.8, 24)]
        position = _held(rng, knots, length, (1.2, 2.2))
        sigma = 0.25
        yaw = (
            yaw
            + np.cumsum(_held(rng, rng.uniform(-2.6, 2.6, (30, 1)), length, (0.5, 1.5))[:, 0])
            / RATE
        )
        pulses = _doublets(rng, length, 0.8, [3], 2.2)
    elif kind == "spiral":
        position[:, :2] = _curve(rng, t, rng.uniform(0.6, 1.1), rng.uniform(0.3, 0.55))
        position[:, 2] = 0.6 + 0.33 * (2 / np.pi) * np.arcsin(
            np.sin(2 * np.pi * t / rng.uniform(4, 7))
        )
        sigma = 0.12
    elif kind == "laps":
        radius = rng.uniform(0.4, 0.65)
        position[:, :2] = _curve(rng, t, rng.uniform(0.6, 1.7), radius)
        yaw_rate_of = 0.0
        sigma = 0.15
    elif kind == "step":
        knots = np.tile(centre, (24, 1)) + rng.choice([-1, 0, 1], (24, 3)) * rng.uniform(
            0.15, 0.35, (24, 3)
        )
        position = _held(rng, knots, length, (1.0, 1.8))
        sigma = 0.07
        position[:, 2] = np.clip(position[:, 2], 0.25, 0.95)
        pulses = _doublets(rng, length, 1.0, [1, 2, 3], 2.2)
    else:
        raise ValueError(f"unknown mission {kind!r}")
    yaw = yaw + yaw_rate_of * t
    if kind != "hover" and rng.random() < 0.3:
        pulses = pulses + _dither(rng, length)
    return _smooth(position, yaw, pulses, sigma)


def _smooth(position, yaw, pulses, sigma):
    # hold the start for half a second: flights start near hover
    hold = int(0.5 * RATE)
    position = np.concatenate([np.repeat(position[:1], hold, 0), position[:-hold]])
    yaw = np.concatenate([np.repeat(yaw[:1], hold), yaw[:-hold]])
    width = sigma * RATE

    def smooth(signal, order):
        return gaussian_filter1d(signal, width, axis=0, order=order, mode="nearest") * RATE**order

    return {
        "position": smooth(position, 0),
        "velocity": smooth(position, 1),
        "acceleration": smooth(position, 2),
        "yaw": smooth(yaw, 0),
        "yaw_rate": smooth(yaw, 1),
        "pulses": pulses,
    }


def apart(reference, side):
    """The reference moved to one half of the arena, so that two vehicles never meet."""
    smaller = {
        k: reference[k] * np.array([0.5, 0.8, 1.0])
        for k in ("position", "velocity", "acceleration")
    }
    smaller["position"] = smaller["position"] + np.array([0.38 * side, 0, 0])
    return reference | smaller


def pair(kind, rng, length):
    """Two vehicles' references; the second passes above the first, so that the first is in its wake
    now and then.
    """
    t = np.arange(length) / RATE
    lower = np.tile(np.r_[rng.uniform(-0.1, 0.1, 2), rng.uniform(0.3, 0.45)], (length, 1))
    if kind == "pass_moving":
        lower[:, :2] += _curve(rng, t, rng.uniform(0.15, 0.35), 0.2)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-np.sin(angle), np.cos(angle)])
    swing = rng.uniform(0.18, 0.3) * np.sin(
        2 * np.pi * t / rng.uniform(2.2, 3.6) + rng.uniform(0, 6)
    )
    aside = 0.06 * np.sin(2 * np.pi * t / rng.uniform(3.7, 6.0) + rng.uniform(0, 6))
    upper = lower.copy()
    upper[:, :2] += swing[:, None] * along + aside[:, None] * across
    gap = _held(rng, rng.uniform(0.14, 0.5, (20, 1)), length, (1.2, 2.4))[:, 0]
    upper[:, 2] += gaussian_filter1d(gap, 25, mode="nearest")
    upper[:, 2] = np.minimum(upper[:, 2], 1.05)
    none = np.zeros((length, 4))
    yaw = np.full(length, rng.uniform(-np.pi, np.pi))
    return _smooth(lower, yaw, none, 0.2), _smooth(upper, -yaw, none.copy(), 0.2)

"""Accelerations of teams, in which a vehicle's estimate drifts gently, drawn at once.

Position and velocity of an estimate drift together. A steady drift shows nowhere: thrust, attitude
and gyroscope tell accelerations and turns, not speeds. While it sets in, the estimate accelerates as
thrust doesn't explain. So do the air's drag, which nobody told the vehicle, and an attitude that is
off by a tenth of a degree.
"""

from __future__ import annotations

import numpy as np

from openjax.flying.drift import FORGETTING, SPREAD, WINDOW

PERIOD = 0.01
SECONDS = 30.0
TEAM = 3
SPEED = 0.7
"""m/s, of a hunting vehicle (rms)."""
BEGIN = (5.0, 12.0)
"""s, when a drift begins, after the hover."""
VEHICLES = {
    "as the simulator: no drag, still air, exact attitude": (0.0, 0.0, 0.0, 0.01),
    "little drag, attitude to .1 degree": (0.1, 0.05, 0.1, 0.02),
    "usual drag, attitude to .2 degrees": (0.4, 0.1, 0.2, 0.02),
    "much drag, attitude to .3 degrees": (0.8, 0.15, 0.3, 0.03),
}
"""Drag (1/s), air that moves (m/s), error of the attitude (degrees) and of the velocity
(m/s, both rms). The sample Crazyflie's drag is .4/s.
"""
FLIGHTS = 300


def wandering(rng: np.random.Generator, time_constant: float, size: float) -> np.ndarray:
    """(T, FLIGHTS, TEAM, 2) of a first-order Gauss-Markov process."""
    steps = round(SECONDS / PERIOD)
    share = PERIOD / time_constant
    noise = size * np.sqrt(2 * share) * rng.standard_normal((steps, FLIGHTS, TEAM, 2))
    out = np.empty_like(noise)
    out[0] = size * rng.standard_normal((FLIGHTS, TEAM, 2))
    for k in range(1, steps):
        out[k] = (1 - share) * out[k - 1] + noise[k]
    return out


def unexplained(
    rng, vehicle, drift, hover: float = 0.0, begins: tuple[float, float] = BEGIN
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What thrust and attitude don't explain of the estimate's acceleration (m/s^2,
    world) and the estimate's velocity (m/s), (T, FLIGHTS, TEAM, 2) each, and when the
    first vehicle's began to drift (s).

    `hover`: how long (s) all hover before they hunt.
    """
    drag, air, tilt, error = vehicle
    speed, seconds = drift
    time = PERIOD * np.arange(round(SECONDS / PERIOD))
    velocity = wandering(rng, 0.6, SPEED)
    # the way to the start is slow, and so is a hover
    velocity *= np.clip(time - hover - 1.5, 0.1, 1.0)[:, None, None, None]
    begin = hover + rng.uniform(*begins, FLIGHTS)
    away = rng.uniform(0.0, 2 * np.pi, FLIGHTS)
    direction = np.stack([np.cos(away), np.sin(away)], 1)
    begun = speed * np.clip((time[:, None] - begin) / seconds, 0.0, 1.0)
    estimate = velocity + wandering(rng, 0.3, error)
    estimate[:, :, 0] += begun[..., None] * direction
    # degrees: rotors, a battery's place
    constant = rng.standard_normal((FLIGHTS, TEAM, 2))
    lean = 9.81 * np.radians(wandering(rng, 5.0, tilt) + constant)
    thrust = np.gradient(velocity, PERIOD, axis=0)
    thrust = thrust + drag * (velocity - wandering(rng, 2.0, air)) + lean
    return np.gradient(estimate, PERIOD, axis=0) - thrust, estimate, begin


def summed(rest: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(T, FLIGHTS, TEAM) m/s, the sum over a window of what a constant and drag don't
    explain.
    """
    normal = np.zeros((*velocity.shape[1:], 2, 2)) + 0.3 * np.eye(2)
    moment = np.zeros((*velocity.shape[1:], 2))
    total = np.zeros(velocity.shape[1:])
    learnt = np.zeros_like(moment)
    decay = np.exp(-PERIOD / FORGETTING)
    out = np.zeros(velocity.shape[:-1])
    for k, (value, speed) in enumerate(zip(rest, velocity, strict=True)):
        inputs = np.stack([np.ones_like(speed), speed], -1)
        residual = value - (learnt * inputs).sum(-1)
        total = np.exp(-PERIOD / WINDOW) * total + PERIOD * residual
        normal = decay * normal + PERIOD * inputs[..., :, None] * inputs[..., None, :]
        normal = normal + (1 - decay) * SPREAD * np.eye(2)
        moment = decay * moment + PERIOD * inputs * value[..., None]
        if k % 10 == 0:
            learnt = np.linalg.solve(normal, moment[..., None])[..., 0]
        out[k] = np.linalg.norm(total, axis=-1)
    return out

"""What teammates tell of a gentle drift of a vehicle's own estimate: `python -m
experiments.flying.observable`.

Position and velocity of an estimate drift together. A steady drift shows nowhere:
thrust, attitude and gyroscope tell accelerations and turns, not speeds. While it sets
in, the estimate accelerates as thrust doesn't explain. So does the air's drag, which
nobody told the vehicle, and an attitude that is off by a tenth of a degree. Level
accelerations of teams are simulated with these, and judged as `openjax.flying.drift`
judges them, all flights at once.
"""

from __future__ import annotations

import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.flying.drift import FLOOR, FORGETTING, LEARNT, RATIO, SPREAD, WINDOW

PERIOD = 0.01
SECONDS = 30.0
TEAM = 3
SPEED = 0.7
"""m/s, of a hunting vehicle (rms)."""
BEGIN = (5.0, 12.0)
"""s, when a drift begins, after the hover."""
SOON = 6.0
"""A drift that is told later (s) isn't counted as told."""
VEHICLES = {
    "as the simulator: no drag, still air, exact attitude": (0.0, 0.0, 0.0, 0.01),
    "little drag, attitude to .1 degree": (0.1, 0.05, 0.1, 0.02),
    "usual drag, attitude to .2 degrees": (0.4, 0.1, 0.2, 0.02),
    "much drag, attitude to .3 degrees": (0.8, 0.15, 0.3, 0.03),
}
"""Drag (1/s), air that moves (m/s), error of the attitude (degrees) and of the velocity
(m/s, both rms). The sample Crazyflie's drag is .4/s.
"""
DRIFTS = {".1 m/s within 2 s": (0.1, 2.0), ".3 m/s within 2 s": (0.3, 2.0)}
DRIFTS |= {".5 m/s within 2 s": (0.5, 2.0), ".5 m/s within 4 s": (0.5, 4.0)}
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


def told(sums: np.ndarray) -> np.ndarray:
    """(FLIGHTS, TEAM) s, when each vehicle is told to drift; infinite for never."""
    sums = sums[round(LEARNT / PERIOD) :]
    seconds = PERIOD * np.arange(1, len(sums) + 1)[:, None, None]
    usual = np.sqrt(PERIOD * np.cumsum(sums**2, 0) / seconds)
    usual[seconds[:, 0, 0] <= 1.0] = np.inf
    others = np.stack([np.delete(usual, i, 2).max(2) for i in range(TEAM)], 2)
    beyond = sums > np.maximum(FLOOR, RATIO * others)
    return np.where(beyond.any(0), LEARNT + PERIOD * beyond.argmax(0), np.inf)


def study(options) -> dict:
    """For each vehicle how many flights without a drift would end, and which drifts are
    told.
    """
    rows = []
    for name, vehicle in VEHICLES.items():
        rng = np.random.default_rng(options.seed)
        times = (options.hover, tuple(options.begin))
        without = told(summed(*unexplained(rng, vehicle, (0.0, 1.0), *times)[:2]))
        row = {"vehicle": name, "ended": float(np.isfinite(without).any(1).mean())}
        for drift, size in DRIFTS.items():
            rest, velocity, begin = unexplained(rng, vehicle, size, *times)
            delays = told(summed(rest, velocity))[:, 0] - begin
            row[drift] = float(((delays > 0.0) & (delays < SOON)).mean())
        rows.append(row)
    return {"flights": FLIGHTS, "rows": rows}


def page(results) -> Page:
    """The study's table."""
    prose = "Share of drifts that are told within six seconds, and of flights that end for none."
    columns = {"vehicle": "vehicle", "ended without a drift": "ended:.3f"}
    columns |= {f"told: {drift}": (lambda row, d=drift: f"{row[d]:.2f}") for drift in DRIFTS}
    return Page("What of a gentle drift can be told", prose, Table(columns, results["rows"]))


if __name__ == "__main__":
    parser = page_parser(__doc__, "flying_drifts")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hover", type=float, default=0.0, help="s, before they hunt")
    parser.add_argument("--begin", type=float, nargs=2, default=BEGIN, help="s, of a drift")
    publish(parser.parse_args(), study, page)

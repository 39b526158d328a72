"""What a vehicle could tell of a gentle drift of its own estimate: `python -m
experiments.flying.observable`.

Position and velocity of an estimate drift together. A steady drift shows nowhere: thrust, attitude
and gyroscope tell accelerations and turns, not speeds. While it sets in, the estimate accelerates
as thrust doesn't explain. So does the air's drag, which nobody told the vehicle, and an attitude
that is off by a tenth of a degree. Level accelerations are simulated with these, and what is left
of a constant and of drag, both learnt in flight (recursive least squares), is summed up over 1.5 s.
It is told where the sum is larger than in any flight without a drift.
"""

from __future__ import annotations

import numpy as np

from experiments.table import Page, Table, page_parser, publish

PERIOD = 0.01
SECONDS = 16.0
BEGIN = 8.0
"""s, when a drift begins."""
SPEED = 0.7
"""m/s, of a hunting vehicle (rms)."""
FORGETTING = 6.0
"""s in which constant and drag are learnt."""
WINDOW = 1.5
"""s over which is summed up what they leave."""
VEHICLES = {
    "as the simulator: no drag, still air, exact attitude": (0.0, 0.0, 0.0, 0.01),
    "little drag, attitude to .1 degree": (0.1, 0.05, 0.1, 0.02),
    "usual drag, attitude to .2 degrees": (0.4, 0.1, 0.2, 0.02),
    "much drag, attitude to .3 degrees": (0.8, 0.15, 0.3, 0.03),
}
"""Drag (1/s), air that moves (m/s), error of the attitude (degrees) and of the velocity (m/s, both
rms). The sample Crazyflie's drag is .4/s.
"""
DRIFTS = {".1 m/s within 2 s": (0.1, 2.0), ".3 m/s within 2 s": (0.3, 2.0)}
DRIFTS |= {".5 m/s within 2 s": (0.5, 2.0), ".5 m/s within 4 s": (0.5, 4.0)}
FLIGHTS = 200


def wandering(rng: np.random.Generator, time_constant: float, size: float) -> np.ndarray:
    """(T, FLIGHTS, 2) of a first-order Gauss-Markov process."""
    steps = round(SECONDS / PERIOD)
    share = PERIOD / time_constant
    noise = size * np.sqrt(2 * share) * rng.standard_normal((steps, FLIGHTS, 2))
    out = np.zeros((steps, FLIGHTS, 2))
    for k in range(1, steps):
        out[k] = (1 - share) * out[k - 1] + noise[k]
    return out


def unexplained(rng, vehicle, drift) -> tuple[np.ndarray, np.ndarray]:
    """What thrust and attitude don't explain of the estimate's acceleration, and the estimate's
    velocity, (T, FLIGHTS, 2) each, m/s^2 and m/s, world.
    """
    drag, air, tilt, error = vehicle
    speed, seconds = drift
    time = PERIOD * np.arange(round(SECONDS / PERIOD))
    velocity = wandering(rng, 0.6, SPEED)
    away = rng.uniform(0.0, 2 * np.pi, FLIGHTS)
    direction = np.stack([np.cos(away), np.sin(away)], 1)
    begun = speed * np.clip((time - BEGIN) / seconds, 0.0, 1.0)
    estimate = velocity + begun[:, None, None] * direction + wandering(rng, 0.3, error)
    lean = 9.81 * np.radians(wandering(rng, 5.0, tilt) + rng.standard_normal((FLIGHTS, 2)))
    thrust = np.gradient(velocity, PERIOD, axis=0)
    thrust = thrust + drag * (velocity - wandering(rng, 2.0, air)) + lean
    return np.gradient(estimate, PERIOD, axis=0) - thrust, estimate


def summed(rest: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(T, FLIGHTS) m/s, the sum over a window of what a constant and drag don't explain."""
    inputs = np.stack([np.ones_like(velocity), velocity], -1)
    normal = np.zeros((*velocity.shape[1:], 2, 2)) + 0.3 * np.eye(2)
    moment = np.zeros((*velocity.shape[1:], 2))
    learnt = np.zeros_like(moment)
    total = np.zeros(velocity.shape[1:])
    kept = np.exp(-PERIOD / FORGETTING)
    out = np.zeros(velocity.shape[:2])
    for k, (value, given) in enumerate(zip(rest, inputs, strict=True)):
        left = value - (learnt * given).sum(-1)
        total = np.exp(-PERIOD / WINDOW) * total + PERIOD * left
        normal = kept * normal + PERIOD * given[..., :, None] * given[..., None, :]
        normal = normal + (1 - kept) * 0.05 * np.eye(2)
        moment = kept * moment + PERIOD * given * value[..., None]
        if k % 10 == 0:
            learnt = np.linalg.solve(normal, moment[..., None])[..., 0]
        out[k] = np.linalg.norm(total, axis=-1)
    return out


def study(options) -> dict:
    """For each vehicle the largest sum without a drift, and the share of drifts that exceed it."""
    after = round(BEGIN / PERIOD)
    rows = []
    for name, vehicle in VEHICLES.items():
        rng = np.random.default_rng(options.seed)
        usual = summed(*unexplained(rng, vehicle, (0.0, 1.0)))[after:].max()
        told = {
            drift: float((summed(*unexplained(rng, vehicle, size))[after:].max(0) > usual).mean())
            for drift, size in DRIFTS.items()
        }
        rows.append({"vehicle": name, "usual": float(usual), **told})
    return {"flights": FLIGHTS, "rows": rows}


def page(results) -> Page:
    """The study's table."""
    prose = "Share of drifts that are told, where no flight without one would be."
    columns = {"vehicle": "vehicle", "largest sum without a drift (m/s)": "usual:.2f"}
    columns |= {f"told: {drift}": (lambda row, d=drift: f"{row[d]:.2f}") for drift in DRIFTS}
    return Page("What of a gentle drift can be told", prose, Table(columns, results["rows"]))


if __name__ == "__main__":
    parser = page_parser(__doc__, "flying_drifts")
    parser.add_argument("--seed", type=int, default=0)
    publish(parser.parse_args(), study, page)

"""Real vehicles in the family of plants: errors of form that nobody tells the simulator and that
aren't a case's cause.

Ranges: motors of 65 to 85 ms, different up and down, 4 to 6 ms late, and gyroscopes of .93 to 1.11
were measured on small brushed vehicles in published flights; maps from duty cycle to thrust are off
the public one by ± 30 % in curvature; propellers of such vehicles have some 3.5e-8 kg m^2.
"""

import numpy as np

from experiments.diagnosis import vehicle
from experiments.diagnosis.vehicle import GRAVITY, MASS, MAX_SPEED, Told

# The firmware's public map: U = A g^2 + B g volts for g grams of all four rotors.
A = -0.0006239
B = 0.088
# times slower down than up: more than was measured is a lag that has a name
SLOW_DOWN = 1.3
HEAVIEST_ON_MAP = 0.034  # kg: beyond, the map's parabola ends below full thrust


def draw(rng, stranger=False):
    """(Told, form errors) of a real vehicle; strangers are heavier and have larger errors."""
    mass = float(rng.uniform(0.05, 0.09) if stranger else rng.uniform(0.027, 0.05))
    size = mass / MASS
    thrust = mass * GRAVITY / (4 * rng.uniform(0.45, 0.62) * MAX_SPEED**2)
    brushed = bool(rng.random() < 0.4)
    told = Told(
        mass=round(mass, 5),
        thrust_constant=float(f"{thrust:.5g}"),
        torque_ratio=float(f"{rng.uniform(0.006, 0.012):.4g}"),
        motor_time=round(
            float(rng.uniform(0.065, 0.085) if brushed else rng.uniform(0.02, 0.04)), 4
        ),
        inertia=tuple(float(f"{v:.4g}") for v in vehicle.INERTIA * size ** rng.uniform(1.0, 1.4)),
        weighed=bool(rng.random() < 0.6),
    )
    more = 1.5 if stranger else 1.0
    return told, {
        "pwm": bool(mass < HEAVIEST_ON_MAP and rng.random() < 0.7),
        "curvature": float(more * rng.uniform(-0.3, 0.3)),
        "sag": float(rng.uniform(0.0, 0.6)),
        "down": float(rng.uniform(1.0, 1.0 + 0.35 * more)),
        "late": float(rng.uniform(0.004, 0.006)) if brushed else 0.0,
        "gyro_gain": float(1.0 + more * rng.uniform(-0.07, 0.11)),
        "pose_delay": float(more * rng.uniform(2.0, 5.0)),
        "propeller_inertia": float(3.5e-8 * size * rng.uniform(0.3, 1.5)),
        "drag": float(rng.uniform(0.002, 0.008)),
    }


def fine(errors, causes):
    """Names that describe a part of these errors: no mistake beside the cause."""
    if errors is None:
        return []
    names = ["state_latency", "rotor_drag"]
    if errors["pwm"]:  # the map isn't known, its scale least of all
        names += ["thrust_curve", "battery_sag", "mass", "thrust_scale"]
    if errors["late"] or errors["down"] > SLOW_DOWN:
        names.append("motor_lag")
    return [name for name in names if name not in causes]


def apply(errors, p, c):
    """Write the errors into the parameters of the bodies `c`."""
    if errors is None:
        return
    p["gyro_gain"][c] *= errors["gyro_gain"]
    p["pose_delay"][c] += errors["pose_delay"]
    p["propeller_inertia"][c] = errors["propeller_inertia"]
    p["drag_xy"][c] += errors["drag"]
    p["drag_z"][c] += 0.6 * errors["drag"]
    p["tau_down"][c] *= errors["down"]
    p["tau_second"][c] = np.maximum(p["tau_second"][c], errors["late"])
    if errors["pwm"]:
        p["curve_quadratic"][c] += errors["curvature"]
        p["curve_root"][c] = p["hover"][c] - 0.25
        p["sag_power"][c] += errors["sag"]


def as_logged(errors, told, rows):
    """The rows with motors as duty cycles where the vehicle is commanded so: the firmware's battery
    compensation.
    """
    if not (errors and errors["pwm"]):
        return rows
    volts = rows["vbat"]
    seen = np.isfinite(volts)
    volts = np.interp(rows["t"], rows["t"][seen], volts[seen])
    out = dict(rows)
    for column in ("m1", "m2", "m3", "m4"):
        grams = 4e3 * rows[column] * told.thrust_constant * MAX_SPEED**2 / GRAVITY
        out[column] = np.clip((A * grams + B) * grams / volts, 0.0, 1.0).round(4)
    return out

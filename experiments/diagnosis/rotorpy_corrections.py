"""RotorPy's vehicles before its published corrections, flown as they are after them:
known mistakes of another simulator, one at a time.

Sources: RotorPy 3.0's `crazyflie_params` and `crazyfliebrushless_params`. Motors of 5
ms became 72 ms (its pull request 35, after arXiv:2404.07837). Its Crazyflie Brushless
has the mass, inertia and drag of arXiv:2603.05944 and of Folk's thesis (2026), where
before only the brushed vehicle's numbers were there. The fourth correction, a gain of
the rate loop from 1 to 200 1/s (its issue 39), can't be told: openjax' own loop has the
firmware's gains, some 240 1/s.
"""

from dataclasses import replace

from experiments.diagnosis.rotorpy_kinds import LAPS, TURNING, TURNS
from experiments.diagnosis.vehicle import Told

CRAZYFLIE = Told(
    mass=0.03,
    thrust_constant=2.3e-8,
    torque_ratio=7.8e-10 / 2.3e-8,
    motor_time=0.072,
    inertia=(1.43e-5, 1.43e-5, 2.89e-5),
    weighed=True,
)
BRUSHLESS = Told(
    mass=0.044,
    thrust_constant=4.052e-8,
    torque_ratio=7.8e-10 / 4.052e-8,
    motor_time=0.05,
    inertia=(3.3e-5, 3.6e-5, 5.9e-5),
    weighed=True,
)
DRAG = {"k_d": 5.09e-6, "k_z": 1.19e-5}  # kg/rad, of the brushless vehicle

BEFORE = {
    "corrected_motors": replace(CRAZYFLIE, motor_time=0.005),
    "corrected_mass": replace(BRUSHLESS, mass=CRAZYFLIE.mass, weighed=False),
    "corrected_inertia": replace(BRUSHLESS, inertia=CRAZYFLIE.inertia),
    "corrected_drag": BRUSHLESS,
}
"""What the simulator is told, by correction."""


def _motors(rng, told, hover):
    tau = CRAZYFLIE.motor_time
    return {"tau_m": tau}, None, {"tau_up": tau, "tau_down": tau}


def _mass(rng, told, hover):
    mass = BRUSHLESS.mass
    return {"mass": mass}, None, {"mass_kg": mass, "ratio": mass / told.mass}


def _inertia(rng, told, hover):
    ratio = [a / b for a, b in zip(BRUSHLESS.inertia, told.inertia, strict=True)]
    moments = dict(zip(("Ixx", "Iyy", "Izz"), BRUSHLESS.inertia, strict=True))
    return moments, None, {"ratio": ratio}


def _drag(rng, told, hover):
    said = {"d_xy": 4 * hover * DRAG["k_d"], "d_z": 4 * hover * DRAG["k_z"]}
    return DRAG, None, said


CORRECTIONS = {
    "corrected_motors": (_motors, ["motor_lag"], "slower", TURNS),
    "corrected_mass": (_mass, ["mass"], "plain", ()),
    "corrected_inertia": (_inertia, ["inertia"], "diagonal", TURNING),
    "corrected_drag": (_drag, ["rotor_drag"], "rotor_speed", LAPS),
}
"""As `rotorpy_kinds.KINDS`."""

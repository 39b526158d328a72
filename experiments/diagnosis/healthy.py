"""Reference flights of a case: the same vehicle on another day, with nothing wrong with it.

A day moves the trims of a vehicle by 1 to 2.5 % of hover (batteries, propellers, how the frame was
put together; measured on published flights of two Crazyflies), its battery's charge and the biases
of its sensors. Everything else is the vehicle's own.
"""

import numpy as np

from experiments.diagnosis import cases
from experiments.diagnosis.fleet import Fleet, bodies, write_case

# of a rotor's thrust, standard deviation: trims of 1.5 % of hover, thrust of 1.5 %
ROTOR = 0.03
CHARGE = 0.1  # V
BIASES = ("accel_bias", "gyro_bias")


def day_of(seed, column, spec, folder):
    """The specification of a case's reference flights: `folder` numbers the day."""
    rng = cases.case_rng(seed, column, spec["number"], 11, folder)
    sensors = dict(spec["sensors"])
    sensors["voltage"] = sensors["voltage"] + rng.normal(0.0, CHARGE)
    for name in BIASES:
        sensors[name] = (rng.uniform(-1.0, 1.0) * np.array(sensors[name])).tolist()
    more = {
        # other air, noise and trajectories
        "number": spec["number"] + 5000 * (1 + folder),
        "category": "none",
        "causes": [],
        "garbage": None,
        "sensors": sensors,
        "day": (1.0 + rng.normal(0.0, ROTOR, 4)).tolist(),
    }
    return spec | more


def write_healthy(seed, column, specs, folder):
    """Fly and write the reference flights of the cases `specs`, whose logs lie in `folder`, into
    the folder beside it that `healthy_beside` names.
    """
    days = [day_of(seed, column, spec, 0) for spec in specs]
    fleet = Fleet(
        seed, column, [(s, []) for s in days], {s["name"]: bodies(seed, column, s) for s in days}
    )
    for i, spec in enumerate(days):
        write_case(fleet, i, healthy_beside(folder) / spec["name"])


def healthy_beside(folder):
    """Where the reference flights of a folder of cases lie."""
    return folder.with_name(folder.name + "_healthy")

"""The nominal vehicle with the numbers of a vehicle file: its mass and inertia, how its
motors are placed and spin, and what a calibration found.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.vehicle import Vehicle
from openjax.vehicle.vehicle_tables import (
    CALIBRATED_UNITS,
    NOMINAL_ORDER,
    CalibratedTable,
    Motor,
    Spin,
    VehicleTable,
)

FAR = 100.0
"""A calibrated value may be this many times the nominal one, or this part of it."""

ROUNDED = 1.02
"""By so much moments of inertia may be off what a body can have: they are rounded.
"""
HEAVY = 1.0
"""kg, above which the Crazyflie's moments of inertia say nothing of a vehicle."""

SAME_ROTORS = 2.0
"""A vehicle up to so many times as heavy still flies with the airframe's rotors: they
lift twice its weight.
"""


@dataclass(frozen=True)
class CalibratedValue:
    """A fitted quantity of the vehicle: `value` and its 90 % interval, tuples of length
    1 (3 for inertia).
    """

    value: tuple[float, ...]
    interval90: tuple[tuple[float, float], ...]
    notes: str = ""


def spins_of(motor: Motor, nominal: Vehicle, root: str) -> tuple[Spin, ...]:
    """The spins of the motors m1 to m4 of the log. Raises UserError unless two spin either way."""
    # an array of NumPy's: going through one of JAX's compiles, which a flight can't
    # that writes its log in a fork
    usual = ["cw" if spin > 0 else "ccw" for spin in np.asarray(nominal.rotor_spin)]
    spins = motor.spin or tuple(usual[NOMINAL_ORDER.index(place)] for place in motor.order)
    if sorted(spins) != ["ccw", "ccw", "cw", "cw"]:
        raise UserError(
            f'{root}motor.spin is {list(spins)}; it must hold two "cw" and two "ccw", in the order '
            "m1..m4"
        )
    return spins


def with_size(nominal: Vehicle, table: VehicleTable, mjcf: Path | None, root: str) -> Vehicle:
    """The nominal vehicle with the moments of inertia that the file gives. One that is
    far heavier or lighter and has no MJCF is taken to be of the same shape: its rotors
    lift the same multiple of its weight, and its arms are longer as its radius of
    gyration is. Raises UserError for a heavy one of which the mass alone is known.
    """
    mass = table.mass
    if mjcf is None and table.inertia is None and mass is not None and mass > HEAVY:
        raise UserError(
            f"{root}vehicle.mass is {mass:g} kg on the airframe {table.airframe!r}: above "
            f"{HEAVY:g} kg give vehicle.inertia (kg m^2 about x, y, z), or an MJCF as the airframe"
        )
    if table.inertia is None:
        return nominal
    if max(table.inertia) > ROUNDED * 0.5 * sum(table.inertia):
        raise UserError(
            f"{root}vehicle.inertia is {list(table.inertia)}; of a body none of the "
            "three is larger "
            "than the sum of the other two"
        )
    changes: dict[str, Any] = {"inertia": table.inertia}
    heavier = 1.0 if mass is None else mass / float(np.asarray(nominal.mass))
    if mjcf is None and not 1.0 / SAME_ROTORS <= heavier <= SAME_ROTORS:
        # moments over mass are the squared radius of gyration, along which the arms
        # grow
        wider = np.mean(np.asarray(table.inertia) / np.asarray(nominal.inertia)) / heavier
        longer = float(np.sqrt(wider))
        changes |= {
            "rotor_position": longer * np.asarray(nominal.rotor_position),
            "thrust_constant": heavier * float(np.asarray(nominal.thrust_constant)),
            "torque_constant": heavier * longer * float(np.asarray(nominal.torque_constant)),
        }
    return with_values(nominal, **changes)


def with_numbers(nominal: Vehicle, mass: float | None, motor: Motor, calibration: dict) -> Vehicle:
    """The nominal vehicle with everything that the file says of it; what a calibration
    found counts most.
    """
    spin = dict(zip(motor.order, motor.spin, strict=True))
    # in the nominal order; +1 where the reaction on the body is along +z (a cw rotor)
    changes: dict[str, Any] = {
        "rotor_spin": [1.0 if spin[name] == "cw" else -1.0 for name in NOMINAL_ORDER]
    }
    if mass is not None:
        changes["mass"] = mass
    for name, entry in calibration.items():
        changes[name] = entry.value if len(entry.value) > 1 else entry.value[0]
    # last, since it multiplies the thrust constant, which a calibration may have
    # changed
    if motor.torque_per_thrust is not None and "torque_constant" not in calibration:
        thrust = changes.get("thrust_constant", float(nominal.thrust_constant))
        changes["torque_constant"] = motor.torque_per_thrust * thrust
    return with_values(nominal, **changes)


def with_values(vehicle: Vehicle, **values) -> Vehicle:
    """The vehicle with other values of some fields, in its own precision."""
    dtype = vehicle.mass.dtype
    return vehicle.replace(**{name: jnp.asarray(value, dtype) for name, value in values.items()})


def calibrated_value(
    name: str, entry: CalibratedTable, nominal: Vehicle, place: str
) -> CalibratedValue:
    """A calibrated quantity of the file. Raises UserError for one that can't be."""
    if (entry.unit or CALIBRATED_UNITS[name]) != CALIBRATED_UNITS[name]:
        raise UserError(f"{place} is in {entry.unit!r}; it must be in {CALIBRATED_UNITS[name]!r}")
    usual = np.atleast_1d(np.asarray(getattr(nominal, name)))
    value = np.atleast_1d(entry.value)
    interval = np.atleast_2d(entry.interval90)
    if value.shape != usual.shape or interval.shape != (usual.size, 2):
        number = f"{usual.size} number{'s' * (usual.size > 1)}"
        raise UserError(f"{place} needs value ({number}) and interval90 ([low, high] each)")
    if not ((usual / FAR <= value) & (value <= usual * FAR)).all():
        raise UserError(f"{place}: {value.tolist()} is far from the nominal {usual.tolist()}")
    if not (interval[:, 0] <= interval[:, 1]).all():
        raise UserError(f"{place}: interval90 is {interval.tolist()}; low must not exceed high")
    return CalibratedValue(tuple(value.tolist()), tuple(map(tuple, interval.tolist())), entry.notes)

"""The tables of `vehicle.toml`: their keys, units and ranges."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, Literal

from openjax.ranges import Interval
from openjax.vehicle.parameters import NOMINAL

NOMINAL_ORDER = ("front_right", "rear_right", "rear_left", "front_left")

CALIBRATED_UNITS = MappingProxyType({
    "mass": "kg",
    "thrust_constant": "N s^2",
    "torque_constant": "N m s^2",
    "motor_time_constant": "s",
    "inertia": "kg m^2",
})  # fmt: skip
"""Quantities that a calibration may hold."""

Place = Literal[*NOMINAL_ORDER]
Spin = Literal["cw", "ccw"]
Quantity = Literal[*CALIBRATED_UNITS]


@dataclass(frozen=True)
class Overrides:
    """`[vehicles.<id>]`: in what one of a flight's vehicles differs."""

    name: str | None = None
    mass: Annotated[float | None, Interval("[0.005, 10]", "kg")] = None
    """The lightest frame weighs twice the least; the most is what one person still
    carries.
    """
    mass_weighed: bool | None = None


@dataclass(frozen=True)
class VehicleTable(Overrides):
    """`[vehicle]`."""

    airframe: str = NOMINAL
    inertia: Annotated[tuple[float, float, float] | None, Interval("(0, 10]", "kg m^2")] = None
    """About the body's x, y and z."""


@dataclass(frozen=True)
class Motor:
    """`[motor]`: what the logged columns m1 to m4 mean."""

    command: Literal["thrust", "pwm"] | None = None
    """None: what the log's format says, and else "thrust"."""
    order: tuple[Place, Place, Place, Place] = NOMINAL_ORDER
    spin: tuple[Spin, Spin, Spin, Spin] | None = None
    """None: that of the nominal vehicle's rotors at these places."""
    notes: str | None = None
    thrust_map: Any = None
    torque_per_thrust: Annotated[float | None, Interval("[1e-6, 1]", "m")] = None


@dataclass(frozen=True)
class CalibratedTable:
    """`[calibrated.<quantity>]`."""

    value: float | tuple[float, ...]
    interval90: tuple[float, float] | tuple[tuple[float, float], ...]
    unit: str | None = None
    notes: str = ""


@dataclass(frozen=True)
class LogKeys:
    """The keys of `[log]` that openjax reads."""

    floor_z: Annotated[float, Interval("[-1000, 1000]", "m")] = 0.0
    ceiling_z: Annotated[float, Interval("[-1000, 1000]", "m")] | None = None
    motor_rows: Literal["mean", "mean_before", "sample"] = "mean"


@dataclass(frozen=True)
class VehicleTables:
    """The file."""

    vehicle: VehicleTable = field(default_factory=VehicleTable)
    vehicles: dict[str, Overrides] = field(default_factory=dict)
    motor: Motor = field(default_factory=Motor)
    calibrated: dict[Quantity, CalibratedTable] = field(default_factory=dict)
    log: dict[str, Any] = field(default_factory=dict)

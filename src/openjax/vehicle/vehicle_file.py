"""`vehicle.toml`: which vehicle flew, how its motors are commanded, and what a
calibration found.

All tables but `[log]` are strict, so that a misspelt key can't be ignored silently.
What the file leaves out is the nominal vehicle.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import tomlkit

from openjax.errors import UserError, suggestion
from openjax.files import read_toml, to_plain, write_text
from openjax.plain import from_plain
from openjax.vehicle import Vehicle, load_vehicle
from openjax.vehicle.parameters import AIRFRAMES, NOMINAL
from openjax.vehicle.vehicle_numbers import (
    CalibratedValue,
    calibrated_value,
    spins_of,
    with_numbers,
    with_size,
    with_values,
)
from openjax.vehicle.vehicle_tables import (
    CALIBRATED_UNITS,
    NOMINAL_ORDER,
    LogKeys,
    Motor,
    Overrides,
    VehicleTables,
)

NOMINAL_NAME = "crazyflie-2.1"


@dataclass(frozen=True, eq=False)
class VehicleFile:
    """The content of a vehicle file. `vehicle` is the nominal one with everything of the file
    applied, its motors in the nominal order; `motor` is of the logged columns.
    """

    vehicle: Vehicle
    name: str = NOMINAL_NAME
    airframe: str = NOMINAL
    """One of `AIRFRAMES`, or the name of an MJCF file beside the vehicle file:
    `mjcf`.
    """
    mass_weighed: bool = False
    motor: Motor = field(default_factory=Motor)
    calibrated: Mapping[str, CalibratedValue] = field(default_factory=dict)
    vehicles: Mapping[str, Overrides] = field(default_factory=dict)
    log: Mapping[str, Any] = field(default_factory=dict)
    path: Path | None = None
    mjcf: Path | None = None

    @property
    def motor_permutation(self) -> tuple[int, ...]:
        """Logged column of each motor in the nominal order: `nominal = logged[...,
        permutation]`.
        """
        return tuple(self.motor.order.index(place) for place in NOMINAL_ORDER)

    def vehicle_of(self, vehicle_id: str) -> Vehicle:
        """The vehicle that flew as `vehicle_id`, with `[vehicles.<id>]` applied."""
        mass = self.vehicles.get(vehicle_id, Overrides()).mass
        return self.vehicle if mass is None else with_values(self.vehicle, mass=mass)

    def mass_weighed_of(self, vehicle_id: str) -> bool:
        """True if the mass of `vehicle_id` was weighed, so that a thrust error can't be explained
        by it.
        """
        of_vehicle = self.vehicles.get(vehicle_id, Overrides()).mass_weighed
        return self.mass_weighed if of_vehicle is None else of_vehicle


def load_vehicle_file(path: str | Path | None = None, dtype=jnp.float32) -> VehicleFile:
    """Read a `vehicle.toml` (or a folder that holds one); None or an airframe's name
    give that nominal vehicle.

    Raises UserError for a missing or unreadable file, an unknown key in a strict table,
    or an impossible value.
    """
    path = Path(NOMINAL if path is None else path)
    if str(path) in AIRFRAMES and not path.exists():
        return VehicleFile(load_vehicle(str(path), dtype), _usual_name(str(path)), str(path))
    # a name without a suffix was meant for an airframe, or for a folder
    if not path.exists() and not path.suffix:
        raise UserError(
            f"{path}: no such vehicle file, nor airframe; {suggestion(str(path), AIRFRAMES)}"
        )
    if path.is_dir():
        path = path / "vehicle.toml"
    tables = read_toml(path, "vehicle file")
    return _from_tables(tables, path, dtype)


def save_vehicle_file(path: str | Path, vehicle_file: VehicleFile) -> None:
    """Write a vehicle file that `load_vehicle_file` reads back to the same vehicle.

    The source file's text, comments included, is kept where there is one;
    `[calibrated]` is written anew.
    """
    if vehicle_file.path:
        document = tomlkit.parse(vehicle_file.path.read_text(encoding="utf-8"))
        document.pop("calibrated", None)
    else:
        document = tomlkit.document()
        document.update(_tables_of(vehicle_file))
    if vehicle_file.calibrated:
        tables = tomlkit.table(is_super_table=True)
        for name, entry in vehicle_file.calibrated.items():
            tables.add(name, _calibrated_table(name, entry))
        document.add("calibrated", tables)
    text = tomlkit.dumps(document)
    # the MJCF first: without it the check would miss the airframe
    _copy_mjcf(vehicle_file, Path(path))
    # never write what can't be read back
    _from_tables(tomllib.loads(text), Path(path), jnp.float32)
    write_text(path, text)


def copy_vehicle_file(source: str | Path, target: Path) -> None:
    """Copy a vehicle file as it is, with the MJCF that it names. Raises UserError where
    it can't be used.
    """
    vehicle_file = load_vehicle_file(source)
    _copy_mjcf(vehicle_file, target)
    write_text(target, vehicle_file.path.read_text(encoding="utf-8"))


def _copy_mjcf(vehicle_file, target):
    """Put the MJCF that a vehicle file names beside another one."""
    source = vehicle_file.mjcf
    # one that lies there already isn't written over itself
    if source is not None and source.resolve().parent != target.resolve().parent:
        write_text(target.with_name(source.name), source.read_text(encoding="utf-8"))


def _usual_name(airframe):
    return NOMINAL_NAME if airframe == NOMINAL else Path(airframe).stem


def _own_mjcf(name, path):
    """The MJCF file that `[vehicle] airframe` of the file at `path` names; None for one
    of `AIRFRAMES`.
    """
    if name in AIRFRAMES:
        return None
    if not name or Path(name).name != name or not path.with_name(name).is_file():
        raise UserError(
            f"{path}: [vehicle] airframe is {name!r}; it must be {', '.join(AIRFRAMES)}, or the "
            "name of an MJCF file beside it"
        )
    return path.with_name(name)


def _from_tables(plain: dict, path: Path, dtype) -> VehicleFile:
    root = f"{path}: "
    tables = from_plain(VehicleTables, plain, root)
    airframe = tables.vehicle
    motor = tables.motor
    # [log] may hold anything: only what openjax reads of it is checked
    log_keys = {f.name for f in fields(LogKeys)}
    log = from_plain(LogKeys, {k: v for k, v in tables.log.items() if k in log_keys}, f"{root}log")
    if log.ceiling_z is not None and log.ceiling_z <= log.floor_z:
        raise UserError(
            f"{root}log.ceiling_z is {log.ceiling_z:g}; it must be above floor_z, {log.floor_z:g} m"
        )
    if sorted(motor.order) != sorted(NOMINAL_ORDER):
        raise UserError(
            f"{root}motor.order is {list(motor.order)}; it must name each of "
            f"{', '.join(NOMINAL_ORDER)} once"
        )
    mjcf = _own_mjcf(airframe.airframe, path)
    nominal = load_vehicle(mjcf or airframe.airframe, dtype)
    motor = replace(motor, spin=spins_of(motor, nominal, root))
    values = {
        name: calibrated_value(name, entry, nominal, f"{root}[calibrated.{name}]")
        for name, entry in tables.calibrated.items()
    }
    with_inertia = with_size(nominal, airframe, mjcf, root)
    return VehicleFile(
        vehicle=with_numbers(with_inertia, airframe.mass, motor, values),
        name=airframe.name or _usual_name(airframe.airframe),
        airframe=airframe.airframe,
        mass_weighed=bool(airframe.mass_weighed),
        motor=motor,
        calibrated=values,
        vehicles=tables.vehicles,
        log=tables.log,
        path=path if path.exists() else None,
        mjcf=mjcf,
    )


def _tables_of(vehicle_file: VehicleFile) -> dict[str, Any]:
    """The tables of a vehicle file that wasn't read from one, without its calibration
    and what is usual.
    """
    tables = {
        "vehicle": {
            "name": vehicle_file.name,
            "airframe": vehicle_file.airframe,
            # as a person writes it: single precision has seven digits, and prints
            # seventeen
            "mass": float(f"{float(vehicle_file.vehicle.mass):.6g}"),
            "mass_weighed": vehicle_file.mass_weighed,
        },
        "vehicles": vehicle_file.vehicles,
        "motor": vehicle_file.motor,
        "log": vehicle_file.log,
    }
    return _without_empty(to_plain(tables))


def _without_empty(plain: dict) -> dict:
    """A tree of tables without empty ones and without None, which TOML hasn't."""
    values = {}
    for name, value in plain.items():
        if isinstance(value, dict):
            value = _without_empty(value)  # which may be empty afterwards
        if value is not None and value != {}:
            values[name] = value
    return values


def _calibrated_table(name: str, entry: CalibratedValue) -> tomlkit.items.Table:
    table = tomlkit.table()
    digits = [float(f"{v:.5g}") for v in entry.value]
    interval = [[float(f"{v:.4g}") for v in pair] for pair in entry.interval90]
    single = len(digits) == 1
    table.add("value", digits[0] if single else digits)
    table.add("interval90", interval[0] if single else interval)
    table.add("unit", CALIBRATED_UNITS[name])
    if entry.notes:
        table.add("notes", entry.notes)
    return table

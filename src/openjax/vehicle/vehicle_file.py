"""`vehicle.toml`: which vehicle flew, how its motors are commanded, and what a calibration found.

`[vehicle]`, `[vehicles.<id>]`, `[motor]` and `[calibrated]` are strict, so that a misspelt key can't be
ignored silently; `[log]` is free. What the file leaves out is the nominal vehicle.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
import tomlkit

from openjax.errors import UserError
from openjax.files import read_toml, write_text
from openjax.vehicle import Vehicle, load_vehicle
from openjax.vehicle.parameters import AIRFRAMES, NOMINAL

NOMINAL_ORDER = ("front_right", "rear_right", "rear_left", "front_left")
NOMINAL_SPIN = ("ccw", "cw", "ccw", "cw")
MOTOR_COMMANDS = ("thrust", "pwm")
NOMINAL_NAME = "crazyflie-2.1"

# Quantities a calibration may hold: unit, number of values (a list for inertia), and what the vehicle calls
# it.
CALIBRATED_UNITS = MappingProxyType({
    "mass": "kg",
    "thrust_constant": "N s^2",
    "torque_constant": "N m s^2",
    "motor_time_constant": "s",
    "inertia": "kg m^2",
})  # fmt: skip

FAR = 100.0
"""A calibrated value may be this many times the nominal one, or this part of it."""

LEAST_MASS = 0.005  # kg; the lightest frame with battery weighs twice that

_TABLES = {"vehicle", "vehicles", "motor", "log", "calibrated"}
_VEHICLE_KEYS = {"name", "mass", "mass_weighed", "airframe"}
_OVERRIDES = {"name", "mass", "mass_weighed"}
_MOTOR_KEYS = {"command", "order", "spin", "notes", "thrust_map", "torque_per_thrust"}
_CALIBRATED_KEYS = {"value", "interval90", "unit", "notes"}
_NO_OVERRIDES: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class CalibratedValue:
    """A fitted quantity of the vehicle: `value` and its 90 % interval, tuples of length 1 (3 for inertia)."""

    value: tuple[float, ...]
    interval90: tuple[tuple[float, float], ...]
    notes: str = ""


@dataclass(frozen=True, eq=False)
class VehicleFile:
    """What a vehicle file says. `vehicle` holds the nominal vehicle with everything of the file applied,
    motors in the nominal order; `motor_order` and `motor_spin` are the file's, for the logged columns
    m1..m4."""

    vehicle: Vehicle
    name: str = NOMINAL_NAME
    airframe: str = NOMINAL
    """One of `AIRFRAMES`, or the name of an MJCF file beside the vehicle file: `mjcf`."""
    mass_weighed: bool = False
    motor_command: str = "thrust"
    motor_order: tuple[str, ...] = NOMINAL_ORDER
    motor_spin: tuple[str, ...] = NOMINAL_SPIN
    motor_notes: str = ""
    thrust_map: Any = None
    torque_per_thrust: float | None = None
    calibrated: Mapping[str, CalibratedValue] = field(default_factory=dict)
    vehicles: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    log: Mapping[str, Any] = field(default_factory=dict)
    mass_given: bool = False
    path: Path | None = None
    mjcf: Path | None = None

    @property
    def motor_permutation(self) -> tuple[int, ...]:
        """Logged column of each motor in the nominal order: `nominal = logged[..., permutation]`."""
        return tuple(self.motor_order.index(place) for place in NOMINAL_ORDER)

    def vehicle_of(self, vehicle_id: str) -> Vehicle:
        """The vehicle that flew as `vehicle_id`, with `[vehicles.<id>]` applied."""
        mass = self.vehicles.get(vehicle_id, _NO_OVERRIDES).get("mass")
        return (
            self.vehicle
            if mass is None
            else self.vehicle.replace(mass=jnp.asarray(mass, self.vehicle.mass.dtype))
        )

    def mass_weighed_of(self, vehicle_id: str) -> bool:
        """Whether the mass of `vehicle_id` was weighed, so that a thrust error can't be explained by it."""
        return bool(self.vehicles.get(vehicle_id, _NO_OVERRIDES).get("mass_weighed", self.mass_weighed))


def load_vehicle_file(path: str | Path | None = None, dtype=jnp.float32) -> VehicleFile:
    """Read a `vehicle.toml` (or a folder that holds one); None or an airframe's name give that nominal vehicle.

    Raises UserError for a missing or unreadable file, an unknown key in a strict table, or an impossible
    value.
    """
    path = Path(NOMINAL if path is None else path)
    if str(path) in AIRFRAMES and not path.exists():
        return VehicleFile(load_vehicle(str(path), dtype), _usual_name(str(path)), str(path))
    if path.is_dir():
        path = path / "vehicle.toml"
    return _from_tables(read_toml(path, "vehicle file"), path, dtype)


def save_vehicle_file(path: str | Path, vehicle_file: VehicleFile) -> None:
    """Write a vehicle file that `load_vehicle_file` reads back to the same vehicle.

    The source file's text, comments included, is kept where there is one; `[calibrated]` is written anew.
    """
    document = (
        tomlkit.parse(vehicle_file.path.read_text(encoding="utf-8"))
        if vehicle_file.path
        else _document(vehicle_file)
    )
    document.pop("calibrated", None)
    if vehicle_file.calibrated:
        tables = tomlkit.table(is_super_table=True)
        for name, entry in vehicle_file.calibrated.items():
            tables.add(name, _calibrated_table(name, entry))
        document.add("calibrated", tables)
    text = tomlkit.dumps(document)
    _copy_mjcf(vehicle_file, Path(path))
    _from_tables(tomllib.loads(text), Path(path), jnp.float32)  # never write what can't be read back
    write_text(path, text)


def copy_vehicle_file(source: str | Path, target: Path) -> None:
    """Copy a vehicle file as it is, with the MJCF that it names. Raises UserError where it can't be used."""
    vehicle_file = load_vehicle_file(source)
    _copy_mjcf(vehicle_file, target)
    write_text(target, vehicle_file.path.read_text(encoding="utf-8"))


def _copy_mjcf(vehicle_file, target):
    """Put the MJCF that a vehicle file names beside another one."""
    source = vehicle_file.mjcf
    if source is not None and source.resolve().parent != target.resolve().parent:
        write_text(target.with_name(source.name), source.read_text(encoding="utf-8"))


def _usual_name(airframe):
    return NOMINAL_NAME if airframe == NOMINAL else Path(airframe).stem


def _own_mjcf(name, path):
    """The MJCF file that `[vehicle] airframe` of the file at `path` names; None for one of `AIRFRAMES`."""
    if isinstance(name, str) and name in AIRFRAMES:
        return None
    plain = isinstance(name, str) and Path(name).name == name
    if not plain or not path.with_name(name).is_file():
        raise UserError(
            f"{path}: [vehicle] airframe is {name!r}; it must be {', '.join(AIRFRAMES)}, or the name of an MJCF file beside it"
        )
    return path.with_name(name)


def _from_tables(tables: dict, path: Path, dtype) -> VehicleFile:
    _only(tables, _TABLES, path, "the file")
    vehicle_table, motor, log = (_table(tables, key, path) for key in ("vehicle", "motor", "log"))
    _only(vehicle_table, _VEHICLE_KEYS, path, "[vehicle]")
    _check_vehicle_table(vehicle_table, path, "[vehicle]")
    vehicles = _table(tables, "vehicles", path)
    for vehicle_id, overrides in vehicles.items():
        if not isinstance(overrides, dict):
            raise UserError(f"{path}: [vehicles] holds tables [vehicles.<id>]; {vehicle_id!r} isn't one")
        _only(overrides, _OVERRIDES, path, f"[vehicles.{vehicle_id}]")
        _check_vehicle_table(overrides, path, f"[vehicles.{vehicle_id}]")
    floor = log.get("floor_z", 0.0)
    if isinstance(floor, bool) or not isinstance(floor, int | float) or not abs(floor) < 1e3:
        raise UserError(f"{path}: log.floor_z is {floor!r}; it must be a number of metres")
    airframe = vehicle_table.get("airframe", NOMINAL)
    mjcf = _own_mjcf(airframe, path)
    nominal = load_vehicle(mjcf or airframe, dtype)
    motors = _motors(motor, path)
    calibrated = _calibrated(_table(tables, "calibrated", path), path, nominal)
    return VehicleFile(
        vehicle=_changed(nominal, vehicle_table, motors, calibrated),
        name=vehicle_table.get("name", _usual_name(airframe)),
        airframe=airframe,
        mass_weighed=vehicle_table.get("mass_weighed", False),
        **motors,
        calibrated=calibrated,
        vehicles=vehicles,
        log=log,
        mass_given="mass" in vehicle_table,
        path=path if path.exists() else None,
        mjcf=mjcf,
    )


def _motors(motor: dict, path: Path) -> dict[str, Any]:
    """The fields of `VehicleFile` that `[motor]` says."""
    _only(motor, _MOTOR_KEYS, path, "[motor]")
    command = motor.get("command", "thrust")
    if command not in MOTOR_COMMANDS:
        raise UserError(f'{path}: motor.command is {command!r}; it must be "thrust" or "pwm"')
    order = _names(motor.get("order", NOMINAL_ORDER), path, "order")
    if sorted(order) != sorted(NOMINAL_ORDER):
        raise UserError(
            f"{path}: motor.order is {list(order)}; it must name each of {', '.join(NOMINAL_ORDER)} once"
        )
    spin = _names(motor.get("spin", _spin_of(order)), path, "spin")
    if sorted(spin) != ["ccw", "ccw", "cw", "cw"]:
        raise UserError(
            f'{path}: motor.spin is {list(spin)}; it must hold two "cw" and two "ccw", in the order m1..m4'
        )
    torque_per_thrust = motor.get("torque_per_thrust")
    if torque_per_thrust is not None:
        _positive(torque_per_thrust, path, "motor.torque_per_thrust")
    return {
        "motor_command": command,
        "motor_order": order,
        "motor_spin": spin,
        "motor_notes": motor.get("notes", ""),
        "thrust_map": motor.get("thrust_map"),
        "torque_per_thrust": torque_per_thrust,
    }


def _changed(nominal: Vehicle, vehicle_table: dict, motors: dict, calibrated: dict) -> Vehicle:
    """The nominal vehicle with everything that the file says of it."""
    changes: dict[str, Any] = {name: vehicle_table[name] for name in ("mass",) if name in vehicle_table}
    # Spin in the nominal order; +1 where the reaction on the body is along +z (a cw rotor).
    spin = dict(zip(motors["motor_order"], motors["motor_spin"], strict=True))
    changes["rotor_spin"] = [1.0 if spin[name] == "cw" else -1.0 for name in NOMINAL_ORDER]
    for name, entry in calibrated.items():
        changes[name] = entry.value if name == "inertia" else entry.value[0]
    ratio = motors["torque_per_thrust"]
    if ratio is not None and "torque_constant" not in calibrated:
        changes["torque_constant"] = ratio * changes.get("thrust_constant", float(nominal.thrust_constant))
    return nominal.replace(**{k: jnp.asarray(v, nominal.mass.dtype) for k, v in changes.items()})


def _calibrated(table: dict, path: Path, nominal: Vehicle) -> dict[str, CalibratedValue]:
    _only(table, set(CALIBRATED_UNITS), path, "[calibrated]")
    result = {}
    for name, entry in table.items():
        where = f"[calibrated.{name}]"
        if not isinstance(entry, dict):
            raise UserError(f"{path}: {where} must be a table with value and interval90")
        _only(entry, _CALIBRATED_KEYS, path, where)
        if entry.get("unit", CALIBRATED_UNITS[name]) != CALIBRATED_UNITS[name]:
            raise UserError(
                f"{path}: {where} is in {entry['unit']!r}; it must be in {CALIBRATED_UNITS[name]!r}"
            )
        n = 3 if name == "inertia" else 1
        try:
            value = np.asarray(entry["value"], float).reshape(-1)
            interval = np.asarray(entry["interval90"], float).reshape(-1, 2)
        except (KeyError, TypeError, ValueError):
            value, interval = np.zeros(0), np.zeros((0, 2))
        if value.shape != (n,) or interval.shape != (n, 2):
            raise UserError(
                f"{path}: {where} needs value ({n} number{'s' * (n > 1)}) and interval90 ([low, high] each)"
            )
        usual = np.atleast_1d(np.asarray(getattr(nominal, name)))
        if not ((usual / FAR <= value) & (value <= usual * FAR)).all():
            raise UserError(f"{path}: {where}: {value.tolist()} is far from the nominal {usual.tolist()}")
        if not (np.isfinite(value).all() and (value > 0).all() and (interval[:, 0] <= interval[:, 1]).all()):
            raise UserError(
                f"{path}: {where}: values must be positive and finite, and low must not exceed high"
            )
        pairs = tuple((float(low), float(high)) for low, high in interval)
        result[name] = CalibratedValue(tuple(value.tolist()), pairs, str(entry.get("notes", "")))
    return result


def _check_vehicle_table(table: dict, path: Path, where: str) -> None:
    if "mass" in table:
        _positive(table["mass"], path, f"{where} mass")
        if not LEAST_MASS <= table["mass"] <= 1.0:
            hint = "; is it in grams?" if table["mass"] > 1.0 else ""
            raise UserError(f"{path}: {where} mass = {table['mass']} kg is no Crazyflie{hint}")
    if not isinstance(table.get("mass_weighed", False), bool):
        raise UserError(f"{path}: {where} mass_weighed must be true or false")
    if not isinstance(table.get("name", ""), str):
        raise UserError(f"{path}: {where} name must be text")


def _document(vehicle_file: VehicleFile) -> tomlkit.TOMLDocument:
    document = tomlkit.document()
    table = tomlkit.table()
    table.add("name", vehicle_file.name)
    if vehicle_file.airframe != NOMINAL:
        table.add("airframe", vehicle_file.airframe)
    table.add("mass", float(f"{float(vehicle_file.vehicle.mass):.6g}"))
    table.value.item("mass").comment("kg, what the simulator should assume")
    table.add("mass_weighed", vehicle_file.mass_weighed)
    document.add("vehicle", table)
    if vehicle_file.vehicles:
        document.add("vehicles", {k: dict(v) for k, v in vehicle_file.vehicles.items()})
    motor = tomlkit.table()
    motor.add("command", vehicle_file.motor_command)
    motor.add("order", list(vehicle_file.motor_order))
    motor.add("spin", list(vehicle_file.motor_spin))
    optional = {
        "torque_per_thrust": vehicle_file.torque_per_thrust,
        "thrust_map": vehicle_file.thrust_map,
        "notes": vehicle_file.motor_notes or None,
    }
    for key, value in optional.items():
        if value is not None:
            motor.add(key, value)
    document.add("motor", motor)
    if vehicle_file.log:
        document.add("log", dict(vehicle_file.log))
    return document


def _calibrated_table(name: str, entry: CalibratedValue) -> tomlkit.items.Table:
    table = tomlkit.table()
    rounded = [float(f"{v:.5g}") for v in entry.value]
    interval = [[float(f"{v:.4g}") for v in pair] for pair in entry.interval90]
    single = len(rounded) == 1
    table.add("value", rounded[0] if single else rounded)
    table.add("interval90", interval[0] if single else interval)
    table.add("unit", CALIBRATED_UNITS[name])
    if entry.notes:
        table.add("notes", entry.notes)
    return table


def _spin_of(order: tuple[str, ...]) -> tuple[str, ...]:
    nominal = dict(zip(NOMINAL_ORDER, NOMINAL_SPIN, strict=True))
    return tuple(nominal[place] for place in order)


def _table(tables: dict, key: str, path: Path) -> dict:
    table = tables.get(key, {})
    if not isinstance(table, dict):
        raise UserError(f"{path}: {key} must be a table: [{key}]")
    return table


def _names(value: Any, path: Path, key: str) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise UserError(f"{path}: motor.{key} must be a list of four names")
    return tuple(value)


def _only(table: dict, known: set[str], path: Path, where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        raise UserError(
            f"{path}: unknown key {unknown[0]!r} in {where}; known are {', '.join(sorted(known))}"
        )


def _positive(value: Any, path: Path, where: str) -> None:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not math.isfinite(value)
        or value <= 0
    ):
        raise UserError(f"{path}: {where} is {value!r}; it must be a positive number")

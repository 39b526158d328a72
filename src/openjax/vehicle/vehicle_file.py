"""`vehicle.toml`: which vehicle flew, how its motors are commanded, and what a
calibration found.

All tables but `[log]` are strict, so that a misspelt key can't be ignored silently.
What the file leaves out is the nominal vehicle.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
import tomlkit

from openjax.errors import UserError, suggestion
from openjax.files import read_toml, to_plain, write_text
from openjax.plain import from_plain
from openjax.ranges import Interval
from openjax.vehicle import Vehicle, load_vehicle
from openjax.vehicle.parameters import AIRFRAMES, NOMINAL

NOMINAL_ORDER = ("front_right", "rear_right", "rear_left", "front_left")
NOMINAL_NAME = "crazyflie-2.1"

CALIBRATED_UNITS = MappingProxyType({
    "mass": "kg",
    "thrust_constant": "N s^2",
    "torque_constant": "N m s^2",
    "motor_time_constant": "s",
    "inertia": "kg m^2",
})  # fmt: skip
"""What a calibration may hold."""

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
class _Vehicle(Overrides):
    """`[vehicle]`."""

    airframe: str = NOMINAL
    inertia: Annotated[
        tuple[float, float, float] | None, Interval("(0, 10]", "kg m^2")
    ] = None
    """About the body's x, y and z."""


@dataclass(frozen=True)
class Motor:
    """`[motor]`: what the logged columns m1 to m4 mean."""

    command: Literal["thrust", "pwm"] = "thrust"
    order: tuple[Place, Place, Place, Place] = NOMINAL_ORDER
    spin: tuple[Spin, Spin, Spin, Spin] | None = None
    """None: that of the nominal vehicle's rotors at these places."""
    notes: str | None = None
    thrust_map: Any = None
    torque_per_thrust: Annotated[float | None, Interval("[1e-6, 1]", "m")] = None


@dataclass(frozen=True)
class _Calibrated:
    """`[calibrated.<quantity>]`."""

    value: float | tuple[float, ...]
    interval90: tuple[float, float] | tuple[tuple[float, float], ...]
    unit: str | None = None
    notes: str = ""


@dataclass(frozen=True)
class _Log:
    """What openjax reads of `[log]`."""

    floor_z: Annotated[float, Interval("[-1000, 1000]", "m")] = 0.0
    ceiling_z: Annotated[float, Interval("[-1000, 1000]", "m")] | None = None
    motor_rows: Literal["mean", "mean_before", "sample"] = "mean"


@dataclass(frozen=True)
class _Tables:
    """The file."""

    vehicle: _Vehicle = field(default_factory=_Vehicle)
    vehicles: dict[str, Overrides] = field(default_factory=dict)
    motor: Motor = field(default_factory=Motor)
    calibrated: dict[Quantity, _Calibrated] = field(default_factory=dict)
    log: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibratedValue:
    """A fitted quantity of the vehicle: `value` and its 90 % interval, tuples of length
    1 (3 for inertia).
    """

    value: tuple[float, ...]
    interval90: tuple[tuple[float, float], ...]
    notes: str = ""


@dataclass(frozen=True, eq=False)
class VehicleFile:
    """What a vehicle file says. `vehicle` is the nominal one with everything of the
    file applied, its motors in the nominal order; `motor` is of the logged columns.
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
        return self.vehicle if mass is None else _changed(self.vehicle, mass=mass)

    def mass_weighed_of(self, vehicle_id: str) -> bool:
        """Whether the mass of `vehicle_id` was weighed, so that a thrust error can't be
        explained by it.
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
        return VehicleFile(
            load_vehicle(str(path), dtype), _usual_name(str(path)), str(path)
        )
    # a name without a suffix was meant for an airframe, or for a folder
    if not path.exists() and not path.suffix:
        raise UserError(
            f"{path}: no such vehicle file, nor airframe; {suggestion(str(path), AIRFRAMES)}"
        )
    if path.is_dir():
        path = path / "vehicle.toml"
    return _from_tables(read_toml(path, "vehicle file"), path, dtype)


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
    tables = from_plain(_Tables, plain, root)
    airframe = tables.vehicle
    motor = tables.motor
    # [log] may hold anything: only what openjax reads of it is checked
    log_keys = {f.name for f in fields(_Log)}
    log = from_plain(
        _Log, {k: v for k, v in tables.log.items() if k in log_keys}, f"{root}log"
    )
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
    motor = replace(motor, spin=_spins(motor, nominal, root))
    calibrated = {
        name: _calibrated(name, entry, nominal, f"{root}[calibrated.{name}]")
        for name, entry in tables.calibrated.items()
    }
    sized = _sized(nominal, airframe, mjcf, root)
    return VehicleFile(
        vehicle=_with_numbers(sized, airframe.mass, motor, calibrated),
        name=airframe.name or _usual_name(airframe.airframe),
        airframe=airframe.airframe,
        mass_weighed=bool(airframe.mass_weighed),
        motor=motor,
        calibrated=calibrated,
        vehicles=tables.vehicles,
        log=tables.log,
        path=path if path.exists() else None,
        mjcf=mjcf,
    )


def _spins(motor: Motor, nominal: Vehicle, root: str) -> tuple[Spin, ...]:
    """How the motors m1 to m4 of the log spin. Raises UserError unless two spin either
    way.
    """
    # an array of NumPy's: going through one of JAX's compiles, which a flight can't
    # that writes its log in a fork
    usual = ["cw" if spin > 0 else "ccw" for spin in np.asarray(nominal.rotor_spin)]
    spins = motor.spin or tuple(
        usual[NOMINAL_ORDER.index(place)] for place in motor.order
    )
    if sorted(spins) != ["ccw", "ccw", "cw", "cw"]:
        raise UserError(
            f'{root}motor.spin is {list(spins)}; it must hold two "cw" and two "ccw", in the order '
            "m1..m4"
        )
    return spins


def _sized(nominal: Vehicle, table: _Vehicle, mjcf: Path | None, root: str) -> Vehicle:
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
        wider = (
            np.mean(np.asarray(table.inertia) / np.asarray(nominal.inertia)) / heavier
        )
        longer = float(np.sqrt(wider))
        changes |= {
            "rotor_position": longer * np.asarray(nominal.rotor_position),
            "thrust_constant": heavier * float(np.asarray(nominal.thrust_constant)),
            "torque_constant": heavier
            * longer
            * float(np.asarray(nominal.torque_constant)),
        }
    return _changed(nominal, **changes)


def _with_numbers(
    nominal: Vehicle, mass: float | None, motor: Motor, calibrated: dict
) -> Vehicle:
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
    for name, entry in calibrated.items():
        changes[name] = entry.value if len(entry.value) > 1 else entry.value[0]
    # last, since it multiplies the thrust constant, which a calibration may have
    # changed
    if motor.torque_per_thrust is not None and "torque_constant" not in calibrated:
        thrust = changes.get("thrust_constant", float(nominal.thrust_constant))
        changes["torque_constant"] = motor.torque_per_thrust * thrust
    return _changed(nominal, **changes)


def _changed(vehicle: Vehicle, **values) -> Vehicle:
    dtype = vehicle.mass.dtype
    return vehicle.replace(
        **{name: jnp.asarray(value, dtype) for name, value in values.items()}
    )


def _calibrated(
    name: str, entry: _Calibrated, nominal: Vehicle, where: str
) -> CalibratedValue:
    """A calibrated quantity of the file. Raises UserError for one that can't be."""
    if (entry.unit or CALIBRATED_UNITS[name]) != CALIBRATED_UNITS[name]:
        raise UserError(
            f"{where} is in {entry.unit!r}; it must be in {CALIBRATED_UNITS[name]!r}"
        )
    usual = np.atleast_1d(np.asarray(getattr(nominal, name)))
    value = np.atleast_1d(entry.value)
    interval = np.atleast_2d(entry.interval90)
    if value.shape != usual.shape or interval.shape != (usual.size, 2):
        number = f"{usual.size} number{'s' * (usual.size > 1)}"
        raise UserError(
            f"{where} needs value ({number}) and interval90 ([low, high] each)"
        )
    if not ((usual / FAR <= value) & (value <= usual * FAR)).all():
        raise UserError(
            f"{where}: {value.tolist()} is far from the nominal {usual.tolist()}"
        )
    if not (interval[:, 0] <= interval[:, 1]).all():
        raise UserError(
            f"{where}: interval90 is {interval.tolist()}; low must not exceed high"
        )
    return CalibratedValue(
        tuple(value.tolist()), tuple(map(tuple, interval.tolist())), entry.notes
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
    return _given(to_plain(tables))


def _given(plain: dict) -> dict:
    """A tree of tables without empty ones and without None, which TOML hasn't."""
    values = {}
    for name, value in plain.items():
        if isinstance(value, dict):
            value = _given(value)  # which may be empty afterwards
        if value is not None and value != {}:
            values[name] = value
    return values


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

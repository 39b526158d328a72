"""The mapping of columns: which column, log variable or message field holds what, in which unit.

A `columns.toml` in a case folder applies to all its logs. A CSV column that it doesn't name and
that has a name of the log format is taken as it is:

    delimiter = ";"  # CSV only; by its header if left out

    [columns]
    t = { from = "timestamp", unit = "ms" }
    x = "pos_x"  # already in the log format's unit
    wx = { from = "gyro.x", unit = "deg/s" }  # a micro-SD log variable
    ax = { from = "/cf1/imu:linear_acceleration.x" }  # a field of a ROS 2 topic
    cmd_wy = { from = "pitch_rate", unit = "deg/s", scale = -1 }

A CSV whose topics have time stamps of their own names each, and what is `of` it; where names begin
as the stamp's does ("imu.time", "imu.wx"), that may be left out:

    t = [
        { from = "pose.time", unit = "ns" },
        { from = "stamp_2", unit = "ns", of = ["wx", "wy", "wz"] },
    ]

Besides the columns of the log format, `roll`, `pitch`, `yaw` (z-y-x, body to world) may stand for
the quaternion.
"""

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from scipy.spatial.transform import Rotation

from openjax.errors import UserError
from openjax.files import read_toml
from openjax.flights.reading import CHANNEL_COLUMNS, LOG_COLUMNS, LogError, LogTable

MAPPING_FILE = "columns.toml"
EULER = ("roll", "pitch", "yaw")

# Factor to the log format's unit.
UNITS = {
    "1": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9,
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "m/s": 1.0, "mm/s": 1e-3,
    "rad": 1.0, "deg": math.pi / 180, "rad/s": 1.0, "deg/s": math.pi / 180, "mrad/s": 1e-3,
    "rpm": math.pi / 30,
    "m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "V": 1.0, "mV": 1e-3,
    "percent": 1e-2, "8bit": 1 / 255, "16bit": 1 / 65535,
}  # fmt: skip

WITH_UNIT = re.compile(r"(.+?) *[(\[](.+)[)\]]").fullmatch
"""A name with its unit: "wx [deg/s]", "x (m)"."""
WRITTEN = {"m/s2": "m/s^2", "m/s²": "m/s^2", "°": "deg", "°/s": "deg/s", "%": "percent", "-": "1"}
"""Other spellings of units."""


@dataclass(frozen=True)
class Source:
    """The source of a column: raw name, and value = scale * raw + offset in the log
    format's unit.
    """

    name: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Clock:
    """A time stamp of some columns: its source, and the columns that are said to be of it."""

    source: Source
    columns: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ColumnMapping:
    """The meaning of each column of a log."""

    columns: dict[str, Source] = field(default_factory=dict)
    """Sources of the log format's columns."""
    delimiter: str = ""
    """Between a CSV's cells; empty where its header shows it."""
    clocks: tuple[Clock, ...] = ()
    """The time stamps where there are several, of which the first is `t`."""

    @property
    def time(self) -> str:
        """The raw name of the column that holds the time."""
        return self.columns["t"].name if "t" in self.columns else "t"

    def names(self) -> tuple[str, ...]:
        """The raw names of a CSV that are read: those it names, and those of the log
        format that it puts nothing in the place of.
        """
        usual = dict.fromkeys(c for c in LOG_COLUMNS if c not in self.columns)
        usual = usual if not set(EULER) & set(self.columns) else _without_attitude(usual)
        return (*usual, *(source.name for source in self.columns.values()))

    def over(self, usual: dict[str, Source]) -> dict[str, Source]:
        """The `usual` sources of columns, and in their place those that the mapping
        names; time is no source.
        """
        base = _without_attitude(usual) if set(EULER) & set(self.columns) else usual
        return base | {c: s for c, s in self.columns.items() if c not in ("t", "vehicle")}

    def table(self, name: str, raw: LogTable) -> LogTable:
        """A raw CSV table with its columns renamed and converted; time starts at zero.

        Columns under the log format's own names are inherited. Raises LogError without time.
        """
        sources = {source.name for source in self.columns.values()}
        named_columns = {
            c: v for c, v in raw.columns.items() if c in LOG_COLUMNS and c not in sources
        }
        columns = (
            named_columns
            if not set(EULER) & set(self.columns)
            else _without_attitude(named_columns)
        )
        remarks = list(raw.remarks)
        for column, source in self.columns.items():
            if column == "vehicle":
                continue
            if source.name in raw.columns:
                columns[column] = source.scale * raw.columns[source.name] + source.offset
            else:
                columns.pop(column, None)
                remarks.append(f"no column {source.name!r} for {column}")
        if "t" not in columns:
            absent = "t"
            if "t" in self.columns:
                absent = f"{self.columns['t'].name!r}, which {MAPPING_FILE} names for t"
            raise LogError(f"no column {absent}; the log has {', '.join(raw.columns)}")
        start = float(np.nanmin(columns["t"]))
        columns["t"] = columns["t"] - start
        columns = with_quaternion(columns)
        return LogTable(name, columns, raw.vehicle, tuple(remarks), clock_start=start)


def _without_attitude(columns: dict) -> dict:
    """Without the quaternion: named angles stand in its place."""
    return {c: v for c, v in columns.items() if c not in CHANNEL_COLUMNS["quaternion"]}


def with_quaternion(
    columns: dict[str, Shaped[np.ndarray, " rows"]],
) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Roll, pitch, yaw replaced by the quaternion, unless that is there."""
    angles = [columns.get(name) for name in EULER]
    rest = {c: v for c, v in columns.items() if c not in EULER}
    if any(a is None for a in angles) or all(c in rest for c in CHANNEL_COLUMNS["quaternion"]):
        return rest
    attitude = Rotation.from_euler("ZYX", np.stack(angles[::-1], 1)).as_quat(scalar_first=True)
    return rest | dict(zip(CHANNEL_COLUMNS["quaternion"], attitude.T, strict=True))


def with_units(mapping: ColumnMapping | None, names: list[str]) -> ColumnMapping:
    """A mapping with what a header's names say of units, "wx [deg/s]": a column of the log
    format is taken from such a name, and a source that the mapping gives without a unit,
    with the brackets or without them, has the unit in them. A column of the log format whose
    unit nobody knows isn't known either.
    """
    mapping = ColumnMapping() if mapping is None else mapping
    units = {name: (match[1], _factor(match[2])) for name in names if (match := WITH_UNIT(name))}
    bare = {name: full for full, (name, _) in units.items() if name not in names}

    def in_header(source: Source) -> Source:
        name = source.name if source.name in names else bare.get(source.name, source.name)
        factor = units.get(name, ("", None))[1]
        has_unit = abs(source.scale) != 1.0 or factor is None
        return replace(source, name=name, scale=source.scale * (1.0 if has_unit else factor))

    columns = {column: in_header(source) for column, source in mapping.columns.items()}
    named_sources = {source.name for source in columns.values()}
    by_angles = CHANNEL_COLUMNS["quaternion"] if set(EULER) & set(columns) else ()
    for column in LOG_COLUMNS:
        name = bare.get(column, "")
        if name and column not in (*columns, *by_angles) and name not in named_sources:
            if (factor := units[name][1]) is not None:
                columns[column] = Source(name, factor)
    clocks = tuple(replace(clock, source=in_header(clock.source)) for clock in mapping.clocks)
    return replace(mapping, columns=columns, clocks=clocks)


def _factor(unit: str) -> float | None:
    """The factor of a unit as a header writes it; None where nobody knows it."""
    unit = unit.strip()
    return UNITS.get(WRITTEN.get(unit, unit))


def load_mapping(path: str | Path) -> ColumnMapping:
    """Read a `columns.toml`. Raises UserError for an unknown key, column or unit."""
    path = Path(path)
    tables = read_toml(path, "table of columns")
    unknown = sorted(set(tables) - {"delimiter", "columns"})
    if unknown or not isinstance(tables.get("columns"), dict):
        problem = f"unknown key {unknown[0]!r}" if unknown else "no table [columns]"
        raise UserError(f"{path}: {problem}; it may hold delimiter and must hold [columns]")
    delimiter = tables.get("delimiter", "")
    if not isinstance(delimiter, str) or len(delimiter) != ("delimiter" in tables):
        raise UserError(f"{path}: delimiter must be one character")
    entries = dict(tables["columns"])
    clocks = ()
    if isinstance(entries.get("t"), list):
        clocks = tuple(_clock(entry, path) for entry in entries.pop("t"))
    columns = {c: source_of(c, entry, path) for c, entry in entries.items()}
    by_name: dict[str, str] = {}
    for column, source in columns.items():
        if by_name.setdefault(source.name, column) != column:
            raise UserError(
                f"{path}: {by_name[source.name]} and {column} are both from {source.name!r}"
            )
    if clocks:
        columns["t"] = clocks[0].source
    return ColumnMapping(columns, delimiter, clocks)


def source_of(column: str, entry, path: Path) -> Source:
    """An entry of a `columns.toml`. Raises UserError for an unknown key, column or unit."""
    possible = (*LOG_COLUMNS, *EULER)
    if column not in possible:
        raise UserError(
            f"{path}: unknown column {column!r} in [columns]; known are {', '.join(possible)}"
        )
    if isinstance(entry, str):
        return Source(entry)
    if not isinstance(entry, dict) or not isinstance(entry.get("from"), str):
        raise UserError(
            f'{path}: {column} must be "NAME" or {{ from = "NAME", unit = "...", scale = ... }}'
        )
    unknown = sorted(set(entry) - {"from", "unit", "scale", "offset"})
    if unknown:
        raise UserError(
            f"{path}: unknown key {unknown[0]!r} for {column}; known are from, unit, scale, offset"
        )
    unit = entry.get("unit", "1")
    if unit not in UNITS:
        raise UserError(f"{path}: unknown unit {unit!r} for {column}; known are {', '.join(UNITS)}")
    numbers = (entry.get("scale", 1.0), entry.get("offset", 0.0))
    if not all(type(n) in (int, float) and math.isfinite(n) for n in numbers):
        raise UserError(f"{path}: scale and offset of {column} must be numbers")
    return Source(entry["from"], UNITS[unit] * numbers[0], float(numbers[1]))


def _clock(entry, path: Path) -> Clock:
    """One of several time stamps. Raises UserError for an unknown column, key or unit."""
    columns = entry.get("of", []) if isinstance(entry, dict) else []
    possible = (*LOG_COLUMNS[2:], *EULER)
    unknown = (
        [name for name in columns if name not in possible]
        if isinstance(columns, list)
        else [columns]
    )
    if unknown:
        raise UserError(
            f"{path}: a time stamp is `of` {unknown[0]!r}; it must be a list of columns out of "
            f"{', '.join(possible)}"
        )
    rest = {k: v for k, v in entry.items() if k != "of"} if isinstance(entry, dict) else entry
    return Clock(source_of("t", rest, path), tuple(columns))

"""Reading flight logs: a CSV file (plain or gzipped) becomes a table of columns, a table becomes flights.

Importers of other formats make the same table, so that everything behind it is shared.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.flight import Flight

# Channel of a Flight: the log's columns, in order.
CHANNEL_COLUMNS = {
    "position": ("x", "y", "z"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "body_rates": ("wx", "wy", "wz"),
    "specific_force": ("ax", "ay", "az"),
    "command_thrust": ("cmd_thrust",),
    "command_body_rates": ("cmd_wx", "cmd_wy", "cmd_wz"),
    "motor_command": ("m1", "m2", "m3", "m4"),
    "battery_voltage": ("vbat",),
}
LOG_COLUMNS = ("t", "vehicle", *(c for columns in CHANNEL_COLUMNS.values() for c in columns))

WHOLE = ("quaternion", "motor_command")  # channels of which a part is a mistake, not a choice
LARGEST = 256 << 20  # bytes of text in one log: a quarter of an hour at 1 kHz; more is no flight log
LARGEST_VALUE = 1e6  # no sensor's reading in SI units is larger; squares of what is would overflow

_EMPTY_CELL = re.compile(r"(?<=,)[ \t]*(?=[,\n])|^[ \t]*(?=,)", re.MULTILINE)
_NOT_A_NUMBER = re.compile(r"(?<=[,\n ])[-+]?(?:nan|na|n/a|null|none)(?=[,\n ])", re.IGNORECASE)


class LogError(UserError):
    """This log can't be used; the message says why, without the log's name."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """One log file as columns of the log format: `columns[name]` (R,) float64, NaN where a cell was empty;
    `vehicle` (R,) ids. `remarks` are things found while reading that don't stop it."""

    name: str
    columns: dict[str, np.ndarray]
    vehicle: np.ndarray
    remarks: tuple[str, ...] = field(default=())


def read_csv(path: str | Path, delimiter: str = ",", known: tuple[str, ...] | None = LOG_COLUMNS) -> LogTable:
    """Read a `.csv` or `.csv.gz` log. Columns outside `known` are left out with a remark (None keeps all).

    Raises LogError if it isn't such a file: unreadable, no header, a cell that is no number.
    """
    path = Path(path)
    text = _text(path)
    header, _, body = text.partition("\n")
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    if delimiter == "," and len(names) == 1 and ";" in header:
        raise LogError(
            "columns are separated by ';'; the log format wants ',' (or a columns.toml with its delimiter)"
        )
    if not any(re.search("[A-Za-z]", name) for name in names):
        raise LogError("the first row holds no column names")
    repeated = {name for name in names if name and names.count(name) > 1}
    if repeated:
        raise LogError(f"column {min(repeated)!r} occurs more than once")
    if not body.strip():
        raise LogError("no rows")
    if delimiter != ",":
        body = body.replace(delimiter, ",")
    if not body.endswith("\n"):
        body += "\n"
    body, remarks = _without_last_if_cut(body, len(names))

    text_columns = {"vehicle"} if known is not None else {"vehicle", *_text_columns(names, body)}
    kept = [i for i, n in enumerate(names) if n and n not in text_columns and (known is None or n in known)]
    unknown = [n for n in names if n and known is not None and n not in known]
    if unknown:
        remarks.append(f"unknown column{'s' * (len(unknown) > 1)} left out: {', '.join(unknown[:8])}")
    if known is not None and "t" not in names:
        raise LogError(
            f"no column t; the log has {', '.join(n for n in names if n)}: say in columns.toml which is which"
        )

    if (_cells_per_line(body) != len(names)).any():
        raise LogError(_why_not(body, names, kept, ValueError("rows of unequal length")))
    # An empty cell becomes NaN; a written "nan" becomes infinite, so that the two can be told apart
    # afterwards.
    spelt = any(letter in body for letter in "nN") and _NOT_A_NUMBER.search(body) is not None
    numbers = _NOT_A_NUMBER.sub("inf", body) if spelt else body
    if any(empty in numbers for empty in (",,", ",\n", "\n,", " ", "\t")) or numbers.startswith(","):
        numbers = _EMPTY_CELL.sub("nan", numbers)
    try:
        values = np.loadtxt(io.StringIO(numbers), delimiter=",", usecols=kept, ndmin=2, comments=None)
    except (ValueError, OverflowError) as error:
        raise LogError(_why_not(body, names, kept, error)) from error
    columns = {}
    for i, column in zip(kept, values.T, strict=True):
        bad = np.isinf(column)
        if bad.any():
            column = np.where(bad, np.nan, column)
            remarks.append(f"column {names[i]}: {bad.sum()} of {len(bad)} rows are NaN or infinite")
        if not np.isnan(column).all():
            columns[names[i]] = np.ascontiguousarray(column)
        elif names[i] in ("t",):
            raise LogError("column t is empty")
    if "vehicle" in names:
        k = names.index("vehicle")
        ids = [line.split(",", k + 1)[k].strip(' \t"') or "0" for line in body.split("\n") if line.strip()]
        vehicle = np.array(ids)
    else:
        vehicle = np.full(len(values), "0")
    return LogTable(path.name, columns, vehicle, tuple(remarks))


def flights_of(
    table: LogTable, motor_permutation: tuple[int, ...] = (0, 1, 2, 3)
) -> tuple[list[Flight], list[str]]:
    """The table's flights, one per vehicle, as logged (not yet sorted, checked or cut), motors in the
    nominal order; and remarks on columns that couldn't be used. Raises LogError without time."""
    if "t" not in table.columns:
        raise LogError(f"no column t; the log has {', '.join(table.columns)}: name it in columns.toml")
    channels, remarks = {}, list(table.remarks)
    for channel, names in CHANNEL_COLUMNS.items():
        found = [n for n in names if n in table.columns]
        if len(found) == len(names):
            values = np.stack([table.columns[n] for n in names], 1)
            absurd = np.abs(values) > LARGEST_VALUE
            if absurd.any():
                remarks.append(
                    f"{', '.join(names)}: {absurd.sum()} values beyond 1e6 are taken as not sampled"
                )
                values = np.where(absurd, np.nan, values)
            if np.isnan(values).all():
                continue
            channels[channel] = values[:, 0] if len(names) == 1 else values
        elif found == ["az"]:
            channels["vertical_force"] = table.columns["az"]
        elif found:
            missing = ", ".join(n for n in names if n not in table.columns)
            if channel in WHOLE:
                raise LogError(f"{', '.join(found)} without {missing}: log {missing}, or none of them")
            remarks.append(f"{', '.join(found)} without {missing}: {channel} is left out; log {missing}")
    if "motor_command" in channels:
        channels["motor_command"] = channels["motor_command"][:, list(motor_permutation)]
    fingerprint = _fingerprint(channels)
    ids = list(dict.fromkeys(table.vehicle.tolist()))
    flights = []
    for vehicle_id in ids:
        rows = np.flatnonzero(table.vehicle == vehicle_id)
        own = {c: v[rows] for c, v in channels.items() if not np.isnan(v[rows]).all()}
        name = table.name if len(ids) == 1 else f"{table.name}:{vehicle_id}"
        flights.append(
            Flight(name, table.name, vehicle_id, table.columns["t"][rows], fingerprint=fingerprint, **own)
        )
    return flights, remarks


def write_csv(path: str | Path, table: LogTable, decimals: dict[str, int] | None = None) -> None:
    """Write a table as a log (gzipped where the name ends in `.gz`, with no time stamp in it: same data, same
    bytes). `decimals` per column; 6 where it isn't named. A NaN becomes an empty cell."""
    decimals = decimals or {}
    names = [n for n in LOG_COLUMNS if n in table.columns or n == "vehicle"]
    cells = []
    for name in names:
        if name == "vehicle":
            cells.append(table.vehicle.tolist())
            continue
        column = np.asarray(table.columns[name], float)
        form = f"%.{decimals.get(name, 6)}f"
        text = np.full(len(column), "", object)
        known = ~np.isnan(column)
        text[known] = [form % v for v in column[known].tolist()]
        cells.append(text.tolist())
    lines = [",".join(names), *(",".join(row) for row in zip(*cells, strict=True))]
    data = ("\n".join(lines) + "\n").encode()
    path = Path(path)
    path.write_bytes(gzip.compress(data, 6, mtime=0) if path.suffix == ".gz" else data)


def _text(path: Path) -> str:
    """A file's text with line ends of one kind. Never unpacks more than LARGEST bytes."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"can't be read: {error}") from error
    if len(data) > LARGEST:
        raise LogError(f"holds more than {LARGEST >> 20} MB of text: no log of a flight; cut it into flights")
    if b"\0" in data:
        raise LogError("not a text file in UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError("not a text file in UTF-8") from error
    return text.replace("\r\n", "\n").replace("\r", "\n").lstrip("\n")


def _cells_per_line(body: str) -> np.ndarray:
    """Cells in each line of `body` that isn't blank."""
    data = np.frombuffer(body.encode(), np.uint8)
    ends = np.flatnonzero(data == ord("\n"))
    commas = np.searchsorted(np.flatnonzero(data == ord(",")), ends)
    solid = np.searchsorted(np.flatnonzero(data > ord(" ")), ends)
    return (np.diff(commas, prepend=0) + 1)[np.diff(solid, prepend=0) > 0]


def _without_last_if_cut(body: str, cells: int) -> tuple[str, list[str]]:
    """The body without its last line if that has too few cells: power was cut while it was written."""
    lines = body.rstrip().rsplit("\n", 1)
    if len(lines) == 2 and lines[1].count(",") + 1 < cells:
        return lines[0] + "\n", ["the last line is cut off and left out"]
    return body, []


def _text_columns(names: list[str], body: str) -> list[str]:
    """Columns whose first row is neither empty nor a number."""
    first = body.split("\n", 1)[0].split(",")
    return [n for n, cell in zip(names, first, strict=False) if cell.strip() and not _is_number(cell)]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell.strip().lower() in ("na", "n/a", "null", "none")
    return True


def _why_not(body: str, names: list[str], kept: list[int], error: ValueError) -> str:
    """The first row that isn't like the header says, in words."""
    for number, line in enumerate(body.split("\n"), 2):
        cells = line.split(",")
        if not line.strip():
            continue
        if len(cells) != len(names):
            return f"line {number} has {len(cells)} cells, the header {len(names)} (cut off or corrupt)"
        for i in kept:
            if cells[i].strip() and not _is_number(cells[i]):
                return f"line {number}, column {names[i]}: {cells[i].strip()!r} is no number"
    return f"not a table of numbers ({error})"


def _fingerprint(channels: dict[str, np.ndarray]) -> str:
    """Hash of the values without time or file layout, so that a renamed, shifted or repacked copy is the
    same."""
    digest = hashlib.sha256()
    for name in ("motor_command", "command_thrust", "body_rates", "specific_force", "position", "quaternion"):
        if name in channels:
            digest.update(name.encode())
            digest.update(np.round(channels[name], 9).tobytes())
    return digest.hexdigest()

"""Reading flight logs: a CSV file (plain or gzipped) becomes a table of columns, a table becomes
flights.

Importers of other formats make the same table, so that everything behind it is shared.
"""

import gzip
import hashlib
import math
import re
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.flight import CHANNEL_COLUMNS, Flight

LOG_COLUMNS = ("t", "vehicle", *(c for columns in CHANNEL_COLUMNS.values() for c in columns))

WHOLE = ("quaternion", "motor_command")  # channels of which a part is a mistake, not a choice
# What one log may hold: a quarter of an hour at 1 kHz is 256 MB of text and a million rows; the
# micro-SD logger of the Crazyflie writes at most some hundred variables; swarms are of tens.
LARGEST = 256 << 20  # bytes of text
MOST_ROWS = 2_000_000
MOST_COLUMNS = 2_000
MOST_VEHICLES = 200
CHUNK = 1 << 20  # bytes that are unpacked at once
NAMES_SHOWN = 12  # of columns in one message
QUOTED = re.compile('"([^"]*)"')
LARGEST_VALUE = 1e6  # no sensor's reading in SI units is larger; squares of what is would overflow


class LogError(UserError):
    """This log can't be used; the message says why, without the log's name."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """One log file as columns of the log format: `columns[name]` (R,) float64, NaN where a cell was
    empty; `vehicle` (R,) ids. `remarks` are things found while reading that don't stop it.
    """

    name: str
    columns: dict[str, np.ndarray]
    vehicle: np.ndarray
    remarks: tuple[str, ...] = field(default=())


def read_csv(
    path: str | Path,
    delimiter: str = ",",
    known: tuple[str, ...] = LOG_COLUMNS,
    time: str = "t",
) -> LogTable:
    """Read a `.csv` or `.csv.gz` log. Columns outside `known` are left out with a remark, whatever
    they hold; the column `time` must be there.

    Raises LogError if it isn't such a file: unreadable, no header, a cell of a known column that is
    no number.
    """
    path = Path(path)
    header, *lines = _text(path).split("\n")
    header = _unquoted(header, delimiter)
    if header.count(delimiter) >= MOST_COLUMNS:
        raise LogError(
            f"the first row has {header.count(delimiter) + 1} cells, more than {MOST_COLUMNS} "
            "columns: has the log lost its line ends?"
        )
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    _check_header(names, delimiter, time)
    lines, remarks = _whole_lines(lines, delimiter, len(names))
    kept = [i for i, name in enumerate(names) if name != "vehicle" and name in known]
    unknown = [n for n in names if n and n not in known]
    if unknown:
        remarks.append(f"unknown column{'s' * (len(unknown) > 1)} left out: {_listed(unknown)}")
    try:
        values = np.loadtxt(
            lines, delimiter=delimiter, usecols=kept, ndmin=2, comments=None, converters=_number
        )
    except (ValueError, OverflowError) as error:
        raise LogError(_why_not(lines, delimiter, names, kept, error)) from error
    columns = {}
    for i, column in zip(kept, values.T, strict=True):
        bad = np.isinf(column)
        if bad.any():
            column = np.where(bad, np.nan, column)
            remarks.append(f"column {names[i]}: {bad.sum()} of {len(bad)} rows are NaN or infinite")
        if not np.isnan(column).all():
            columns[names[i]] = np.ascontiguousarray(column)
    vehicle = np.full(len(values), "0")
    if "vehicle" in names:
        k = names.index("vehicle")
        vehicle = np.array([line.split(delimiter, k + 1)[k].strip(' \t"') or "0" for line in lines])
    return LogTable(path.name, columns, vehicle, tuple(remarks))


def flights_of(
    table: LogTable, motor_permutation: tuple[int, ...] = (0, 1, 2, 3)
) -> tuple[list[Flight], list[str]]:
    """The table's flights, one per vehicle, as logged (not yet sorted, checked or cut), motors in
    the nominal order; and remarks on columns that couldn't be used. Raises LogError without
    time.
    """
    if "t" not in table.columns:
        raise LogError(
            f"no column t; the log has {_listed(table.columns)}: name it in columns.toml"
        )
    remarks = list(table.remarks)
    read = {c: _channel(table, c, names, remarks) for c, names in CHANNEL_COLUMNS.items()}
    channels = {c: v for c, v in read.items() if v is not None}
    if "motor_command" in channels:
        channels["motor_command"] = channels["motor_command"][:, list(motor_permutation)]
    fingerprint = _fingerprint(channels)
    ids = list(dict.fromkeys(table.vehicle.tolist()))
    if len(ids) > MOST_VEHICLES:
        raise LogError(
            f"column vehicle holds {len(ids)} ids, {_listed(ids, 3)}; it names which vehicle a row "
            "belongs to"
        )
    flights = []
    for vehicle_id in ids:
        rows = np.flatnonzero(table.vehicle == vehicle_id)
        own = {c: v[rows] for c, v in channels.items() if not np.isnan(v[rows]).all()}
        name = table.name if len(ids) == 1 else f"{table.name}:{vehicle_id}"
        flights.append(
            Flight(
                name,
                table.name,
                vehicle_id,
                table.columns["t"][rows],
                fingerprint=fingerprint,
                **own,
            )
        )
    return flights, remarks


def _channel(table: LogTable, channel: str, names, remarks: list[str]) -> np.ndarray | None:
    """(T,) or (T, columns) of one channel; None where it wasn't logged."""
    found = [n for n in names if n in table.columns]
    if len(found) < len(names):
        missing = ", ".join(n for n in names if n not in table.columns)
        if found and channel in WHOLE:
            raise LogError(f"{', '.join(found)} without {missing}: log {missing}, or none of them")
        if found:
            remarks.append(
                f"{', '.join(found)} without {missing}: {channel} is left out; log {missing}"
            )
        return None
    values = np.stack([table.columns[n] for n in names], 1)
    absurd = np.abs(values) > LARGEST_VALUE
    if absurd.any():
        remarks.append(
            f"{', '.join(names)}: {absurd.sum()} values beyond 1e6 are taken as not sampled"
        )
        values = np.where(absurd, np.nan, values)
    if np.isnan(values).all():
        return None
    return values[:, 0] if len(names) == 1 else values


def write_csv(path: str | Path, table: LogTable, decimals: dict[str, int] | None = None) -> None:
    """Write a table as a log (gzipped where the name ends in `.gz`, with no time stamp in it: same
    data, same bytes). `decimals` per column; 6 where it isn't named. A NaN becomes an empty
    cell.
    """
    decimals = decimals or {}
    names = [n for n in LOG_COLUMNS if n in table.columns or n == "vehicle"]

    def cells(name):
        if name == "vehicle":
            return table.vehicle.tolist()
        form = f"%.{decimals.get(name, 6)}f"
        return [
            "" if math.isnan(v) else form % v
            for v in np.asarray(table.columns[name], float).tolist()
        ]

    lines = [",".join(names), *(",".join(row) for row in zip(*map(cells, names), strict=True))]
    data = ("\n".join(lines) + "\n").encode()
    path = Path(path)
    path.write_bytes(gzip.compress(data, 6, mtime=0) if path.suffix == ".gz" else data)


def _text(path: Path) -> str:
    """A file's text with line ends of one kind, without blank lines at its start. Stops unpacking
    at LARGEST bytes or MOST_ROWS lines.
    """
    chunks = []
    size = 0
    lines = 0
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            while chunk := file.read(CHUNK):
                chunks.append(chunk)
                size += len(chunk)
                lines += max(chunk.count(b"\n"), chunk.count(b"\r"))
                if size > LARGEST:
                    raise LogError(
                        f"holds more than {LARGEST >> 20} MB of text: no log of a flight; cut it "
                        "into flights"
                    )
                if lines > MOST_ROWS:
                    raise LogError(
                        f"holds more than {MOST_ROWS} lines: no log of a flight; cut it into "
                        "flights"
                    )
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"can't be read: {error}") from error
    data = b"".join(chunks)
    if b"\0" in data:
        raise LogError("not a text file in UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError("not a text file in UTF-8") from error
    return text.replace("\r\n", "\n").replace("\r", "\n").lstrip("\n")


def _check_header(names: list[str], delimiter: str, time: str) -> None:
    if delimiter == "," and len(names) == 1 and ";" in names[0]:
        raise LogError(
            "columns are separated by ';'; the log format wants ',' (or a columns.toml with its "
            "delimiter)"
        )
    if not any(re.search("[A-Za-z]", name) for name in names):
        raise LogError("the first row holds no column names")
    counts = Counter(names)
    repeated = [name for name in names if name and counts[name] > 1]
    if repeated:
        raise LogError(f"column {min(repeated)!r} occurs more than once")
    if time not in names:
        asked = "t" if time == "t" else f"{time!r}, which columns.toml names for t"
        raise LogError(
            f"no column {asked}; the log has {_listed(n for n in names if n)}: say in columns.toml "
            "which is which"
        )


def _listed(names: Iterable[str], most: int = NAMES_SHOWN) -> str:
    """The first names, and how many more there are."""
    names = list(names)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _whole_lines(lines: list[str], delimiter: str, cells: int) -> tuple[list[str], list[str]]:
    """The lines that aren't blank, and a remark where the last was cut off: power went while it was
    written.
    """
    numbered = [
        (number, _unquoted(line, delimiter)) for number, line in enumerate(lines, 2) if line.strip()
    ]
    remarks = []
    if len(numbered) > 1 and numbered[-1][1].count(delimiter) + 1 < cells:
        del numbered[-1]
        remarks.append("the last line is cut off and left out")
    for number, line in numbered:
        if (found := line.count(delimiter) + 1) != cells:
            raise LogError(
                f"line {number} has {found} cells, the header {cells} (cut off or corrupt)"
            )
    if not numbered:
        raise LogError("no rows")
    return [line for _, line in numbered], remarks


def _unquoted(line: str, delimiter: str) -> str:
    """A line without quotes around its cells, and without the delimiters that stand in them."""
    if '"' not in line:
        return line
    return QUOTED.sub(lambda cell: cell[1].replace(delimiter, " "), line)


def _number(cell: str) -> float:
    """A cell's number: NaN where it is empty, infinite where somebody wrote that it is none, so
    that the two can be told apart. Raises ValueError for anything else.
    """
    try:
        value = float(cell)
    except ValueError:
        text = cell.strip().lower()
        if text and text not in ("na", "n/a", "null", "none"):
            raise
        return math.inf if text else math.nan
    return math.inf if math.isnan(value) else value


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _why_not(
    lines: list[str], delimiter: str, names: list[str], kept: list[int], error: Exception
) -> str:
    """The first cell that is no number, in words. `lines` are those that aren't blank."""
    for number, line in enumerate(lines, 2):
        cells = line.split(delimiter)
        for i in kept:
            if not _is_number(cells[i]):
                return f"line {number}, column {names[i]}: {cells[i].strip()!r} is no number"
    return f"not a table of numbers ({error})"


def _fingerprint(channels: dict[str, np.ndarray]) -> str:
    """Hash of the values without time or file layout, so that a renamed, shifted or repacked copy
    is the same.
    """
    digest = hashlib.sha256()
    for name in (
        "motor_command",
        "command_thrust",
        "body_rates",
        "specific_force",
        "position",
        "quaternion",
    ):
        if name in channels:
            digest.update(name.encode())
            digest.update(np.round(channels[name], 9).tobytes())
    return digest.hexdigest()

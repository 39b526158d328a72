"""A log as a CSV file, plain or gzipped: read into a table of columns, and written from one."""

import gzip
import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from openjax.flights.csv_text import (
    LETTER,
    SEPARATORS,
    Header,
    LogError,
    find_header,
    remove_quotes,
    text_of,
)
from openjax.flights.reading import LOG_COLUMNS, LONGEST_NAME, LogTable, name_list

# the micro-SD logger of the Crazyflie writes at most some hundred variables
MOST_COLUMNS = 2_000
NOTHING = ("na", "n/a", "#n/a", "null", "none", "-", "--")
"""What is written where there is no number, beside nan."""


def read_csv(
    path: str | Path,
    delimiter: str = "",
    readable_columns: tuple[str, ...] = LOG_COLUMNS,
    time: str = "t",
    above: int = 0,
) -> LogTable:
    """Read a `.csv` or `.csv.gz` log. Columns outside `readable_columns` are left out
    with a remark, whatever they hold; the column `time` must be there.

    Args:
      path: the file.
      delimiter: between cells; where it is empty, what the header shows.
      readable_columns: columns that are read.
      time: the one that must be there.
      above: lines above the header that aren't the table's.

    Raises LogError if it isn't such a file: unreadable, no header, a cell of a known
    column that is no number.
    """
    path = Path(path)
    lines = text_of(path).split("\n")
    header = find_header(lines[above:], delimiter)
    header = header._replace(line=above + header.line)
    _check_header(header, time)
    names = header.names
    places = [i for i, name in enumerate(names) if name != "vehicle" and name in readable_columns]
    rows, remarks = _whole_lines(lines, header)
    number = _number if header.delimiter == "," else _number_with_comma
    rows, unit_remarks = _without_units(rows, header, places, number)
    remarks += unit_remarks
    unknown = [n for n in names if n and n not in readable_columns]
    if unknown:
        remarks.append(f"unknown column{'s' * (len(unknown) > 1)} left out: {name_list(unknown)}")
    values = _numbers(rows, header, places, number)
    remarks += _not_numbers(np.isinf(values), [names[i] for i in places])
    # the two could be told apart so far: empty cells, and such as hold no number
    values[np.isinf(values)] = np.nan
    columns = {
        names[i]: np.ascontiguousarray(column)
        for i, column in zip(places, values.T, strict=True)
        if not np.isnan(column).all()
    }
    vehicle = np.full(len(values), "0")
    if "vehicle" in names:
        vehicle = _vehicles(rows, header.delimiter, names.index("vehicle"))
    return LogTable(path.name, columns, vehicle, tuple(remarks))


def _numbers(
    rows: list[tuple[int, str]], header: Header, places: list[int], number: Callable[[str], float]
) -> np.ndarray:
    """(R, columns) of the columns `places`. Raises LogError where a cell is no number."""
    lines = [line for _, line in rows]
    try:
        return np.loadtxt(
            lines,
            delimiter=header.delimiter,
            usecols=places,
            ndmin=2,
            comments=None,
            converters=number,
        )
    except (ValueError, OverflowError) as error:
        # looked for only now: cell by cell takes many times as long as the whole table
        raise LogError(_why_not(rows, header, places, number, error)) from error


def _not_numbers(bad: np.ndarray, names: list[str]) -> list[str]:
    """Remarks on the columns `names` in which some rows (R, columns) are written as no
    number; one for columns of which it is as many.
    """
    columns_of: dict[int, list[str]] = {}
    for name, count in zip(names, bad.sum(0).tolist(), strict=True):
        columns_of.setdefault(count, []).append(name)
    return [
        f"column{'s' * (len(columns) > 1)} {name_list(columns)}: {count} of {len(bad)} rows are "
        "NaN or infinite"
        for count, columns in columns_of.items()
        if count
    ]


def _vehicles(rows: list[tuple[int, str]], delimiter: str, column: int) -> np.ndarray:
    """(R,) ids of a column; "0" where it is empty."""
    cells = (line.split(delimiter, column + 1)[column] for _, line in rows)
    return np.array([cell.strip(' \t"') or "0" for cell in cells])


def write_csv(path: str | Path, table: LogTable, decimals: dict[str, int] | None = None) -> None:
    """Write a table as a log (gzipped where the name ends in `.gz`, with no time stamp in it: same
    data, same bytes). `decimals` per column; 6 where it isn't named. A NaN becomes an empty cell.
    """
    names = [n for n in LOG_COLUMNS if n in table.columns or n == "vehicle"]
    data = f"{','.join(names)}\n{csv_rows(table, names, decimals or {})}".encode()
    path = Path(path)
    path.write_bytes(gzip.compress(data, 6, mtime=0) if path.suffix == ".gz" else data)


def csv_rows(table: LogTable, names: Sequence[str], decimals: dict[str, int]) -> str:
    """The lines of a table, without a header: the columns `names`, as `write_csv` says."""

    def cells(name):
        if name == "vehicle":
            return table.vehicle.tolist()
        form = f"%.{decimals.get(name, 6)}f"
        numbers = np.asarray(table.columns[name], float).tolist()
        return ["" if math.isnan(number) else form % number for number in numbers]

    return "".join(",".join(row) + "\n" for row in zip(*map(cells, names), strict=True))


def _check_header(header: Header, time: str) -> None:
    """Raises LogError for a header that is none, or that lacks the column `time`."""
    names = header.names
    if len(names) > MOST_COLUMNS:
        raise LogError(
            f"the first row has {len(names)} cells, more than {MOST_COLUMNS} columns: has the log "
            "lost its line ends?"
        )
    if len(names) == 1:
        _check_separator(names[0], header.delimiter, time)
    if not any(map(LETTER.search, names)):
        raise LogError("the first row holds no column names")
    counts = Counter(names)
    repeats = [name for name in names if name and counts[name] > 1]
    if repeats:
        raise LogError(f"column {min(repeats)!r} occurs more than once")
    if time not in names:
        time_name = "t" if time == "t" else f"{time!r}, which columns.toml names for t"
        raise LogError(
            f"no column {time_name}; the log has {name_list(n for n in names if n)}: say in "
            "columns.toml which is which"
        )


def _check_separator(line: str, delimiter: str, time: str) -> None:
    """Raises LogError where a header's cells are separated by something else than they
    are read by.
    """
    other = max(SEPARATORS, key=line.count)
    if line.count(other) > 1:
        raise LogError(f"columns are separated by {other!r}, and columns.toml says {delimiter!r}")
    if len(line.split()) > 2 and time in line.split():
        raise LogError("columns are separated by spaces; the log format wants ','")


def _whole_lines(lines: list[str], header: Header) -> tuple[list[tuple[int, str]], list[str]]:
    """The lines below the header that aren't blank, each with its number in the file,
    and a remark where the last was cut off: power went while it was written.
    """
    delimiter = header.delimiter
    cells = len(header.names)
    rows = enumerate(lines[header.line + 1 :], header.line + 2)
    whole_lines = [
        (number, remove_quotes(line, delimiter)) for number, line in rows if line.strip()
    ]
    # a delimiter at the end of each line but the header's, as a loop in C writes it
    if whole_lines and all(line.count(delimiter) == cells for _, line in whole_lines[:2]):
        whole_lines = [
            (number, line.rstrip().removesuffix(delimiter)) for number, line in whole_lines
        ]
    remarks = []
    if len(whole_lines) > 1 and whole_lines[-1][1].count(delimiter) + 1 < cells:
        del whole_lines[-1]
        remarks.append("the last line is cut off and left out")
    for number, line in whole_lines:
        if (cell_count := line.count(delimiter) + 1) != cells:
            raise LogError(
                f"line {number} has {cell_count} cells, the header {cells} (cut off or corrupt)"
            )
    if not whole_lines:
        raise LogError("no rows")
    return whole_lines, remarks


def _without_units(
    rows: list[tuple[int, str]], header: Header, places: list[int], number: Callable[[str], float]
) -> tuple[list[tuple[int, str]], list[str]]:
    """The lines without a first one that holds units or other words, and a remark on it."""
    row, first = rows[0]
    cells = first.split(header.delimiter)
    units = [cells[i] for i in places if cells[i].strip()]
    words = [cell for cell in units if not _is_number(cell, number)]
    if len(rows) < 2 or len(words) < 2 or 2 * len(words) <= len(units):
        return rows, []
    return rows[1:], [f"line {row} holds words, no numbers, and is left out"]


def _number(cell: str) -> float:
    """A cell's number: NaN where it is empty, infinite where somebody wrote that it is
    none, so that the two can be told apart. Raises ValueError for anything else.
    """
    try:
        value = float(cell)
    except ValueError:
        text = cell.strip().lower()
        if text and text not in NOTHING:
            raise
        return math.inf if text else math.nan
    return math.inf if math.isnan(value) else value


def _number_with_comma(cell: str) -> float:
    """The same of a cell that may have a decimal comma, as beside semicolons."""
    return _number(cell.replace(",", "."))


def _is_number(cell: str, number: Callable[[str], float]) -> bool:
    try:
        number(cell)
    except ValueError:
        return False
    return True


def _why_not(
    rows: list[tuple[int, str]],
    header: Header,
    places: list[int],
    number: Callable[[str], float],
    error: Exception,
) -> str:
    """The first cell that is no number, in words."""
    names = header.names
    for row, line in rows:
        cells = line.split(header.delimiter)
        for i in places:
            if _is_number(cells[i], number):
                continue
            if [cell.strip() for cell in cells] == names:
                return f"line {row} is the header again: several recordings in one file"
            cell = cells[i].strip()[:LONGEST_NAME]
            hint = ": a date or a time of day? t counts seconds" * (":" in cell)
            return f"line {row}, column {names[i]}: {cell!r} is no number{hint}"
    return f"not a table of numbers ({error})"

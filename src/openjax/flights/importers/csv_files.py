"""Functions that the importers of CSV layouts share."""

from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from openjax.flights.csv_table import read_csv
from openjax.flights.csv_text import find_header, head_of
from openjax.flights.importers.columns import ColumnMapping
from openjax.flights.reading import LOG_COLUMNS, LogError

TIME_UNITS = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
# s between rows; units are a factor of a thousand apart, so this need not be near
USUAL_STEP = 0.01


def is_csv(path: Path) -> bool:
    """True if a path is a CSV file by its name."""
    return path.is_file() and path.name.lower().endswith((".csv", ".csv.gz"))


def header_of(path: Path, delimiter: str = "") -> list[str]:
    """The names in a CSV file's header; none where there is no such file, or it isn't
    text. Without a `delimiter`, what the header shows.
    """
    if not is_csv(path):
        return []
    try:
        return find_header(head_of(path), delimiter).names
    except LogError:
        return []


def is_log_format(names: list[str]) -> bool:
    """True if a header's names are the log format's own: its time, and something of a flight."""
    return "t" in names and bool(set(names) & set(LOG_COLUMNS) - {"t", "vehicle"})


def delimiter_of(mapping: ColumnMapping | None) -> str:
    """The delimiter of a CSV's cells, if a `columns.toml` says so; else nothing."""
    return "" if mapping is None else mapping.delimiter


def raw_columns(
    path: Path, names: tuple[str, ...], time: str, delimiter: str = "", above: int = 0
) -> tuple[dict[str, Shaped[np.ndarray, " rows"]], list[str]]:
    """The columns `names` of a CSV, {name: (R,)}, and remarks; what else it holds is
    another's business. Raises LogError where the column `time` or a number is missing.
    """
    table = read_csv(path, delimiter, names, time, above)
    if time not in table.columns:
        raise LogError(f"column {time} holds no number")
    return table.columns, [r for r in table.remarks if not r.startswith("unknown column")]


def seconds_per_unit(time: Shaped[np.ndarray, " rows"]) -> float:
    """The seconds of one unit of a clock's readings (R,): of s, ms, us and ns the unit in which
    rows come nearest to a usual step.
    """
    steps = np.diff(np.unique(time[np.isfinite(time)]))
    if not len(steps):
        return 1.0
    step = float(np.median(steps))
    return min(TIME_UNITS, key=lambda unit: abs(np.log(step * unit / USUAL_STEP)))

"""CSV files of the log format, and any others whose columns a `columns.toml` names."""

import re
from pathlib import Path

from openjax.flights.csv_table import read_csv
from openjax.flights.importers.columns import UNITS, ColumnMapping, Source
from openjax.flights.importers.csv_files import header_of, is_csv
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.topic_times import read_topic_times
from openjax.flights.reading import LOG_COLUMNS, LogTable

WITH_UNIT = re.compile(r"(\w+) *[(\[](.+)[)\]]")
"""A name with its unit: "wx [deg/s]", "x (m)"."""
WRITTEN = {"m/s2": "m/s^2", "m/s²": "m/s^2", "°": "deg", "°/s": "deg/s", "%": "percent", "-": "1"}
"""Other spellings of units."""


def read_log_format(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """A CSV as a table. Raises LogError where it can't be read."""
    if mapping is None:
        mapping = units_of(header_of(path))
    if not mapping.columns:
        return read_csv(path)
    if mapping.clocks:
        return read_topic_times(path, mapping)
    table = read_csv(path, mapping.delimiter, mapping.names(), mapping.time)
    return mapping.table(path.name, table)


def units_of(names: list[str]) -> ColumnMapping:
    """A mapping of the log format's columns that a header names with their units; of a
    unit that nobody knows the column isn't known either.
    """
    columns = {}
    for name in names:
        match = WITH_UNIT.fullmatch(name)
        if match and match[1] in LOG_COLUMNS and match[1] not in names:
            unit = match[2].strip()
            unit = WRITTEN.get(unit, unit)
            if unit in UNITS:
                columns[match[1]] = Source(name, UNITS[unit])
    return ColumnMapping(columns)


IMPORTER = Importer("CSV of the log format", is_csv, read_log_format)

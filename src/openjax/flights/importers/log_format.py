"""CSV files of the log format, and any others whose columns a `columns.toml` names."""

from dataclasses import replace
from pathlib import Path

from openjax.flights.csv_table import read_csv
from openjax.flights.importers.columns import ColumnMapping, with_units
from openjax.flights.importers.csv_files import delimiter_of, header_of, is_csv
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.topic_times import read_topic_times
from openjax.flights.reading import LogTable


def read_log_format(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """A CSV as a table. Raises LogError where it can't be read."""
    mapping = with_units(mapping, header_of(path, delimiter_of(mapping)))
    if not mapping.columns:
        return replace(read_csv(path), clock_start=0.0)
    if mapping.clocks:
        return read_topic_times(path, mapping)
    table = read_csv(path, mapping.delimiter, mapping.names(), mapping.time)
    return mapping.table(path.name, table)


IMPORTER = Importer("CSV of the log format", is_csv, read_log_format)

"""Importers: logs of other formats become the same table as a CSV of the log format.

A case folder may hold CSV logs, Bitcraze micro-SD logs and ROS 2 bags side by side. A
`columns.toml` in the folder says which of their columns is what, where the names aren't the usual
ones.
"""

from pathlib import Path

from openjax.flights.importers.columns import MAPPING_FILE, ColumnMapping, load_mapping
from openjax.flights.importers.micro_sd import is_micro_sd, read_micro_sd
from openjax.flights.importers.ros2 import is_bag, read_bag
from openjax.flights.reading import LogTable, read_csv

__all__ = ["MAPPING_FILE", "ColumnMapping", "find_logs", "load_mapping", "read_log"]


def find_logs(folder: Path) -> list[Path]:
    """The logs of a case folder, by name."""
    return sorted(p for p in folder.iterdir() if _is_csv(p) or is_bag(p) or is_micro_sd(p))


def read_log(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """One log of any known format as a table. Raises LogError if it can't be read."""
    if is_bag(path):
        return read_bag(path, mapping)
    if not _is_csv(path):
        return read_micro_sd(path, mapping)
    if mapping is None:
        return read_csv(path)
    return mapping.table(
        path.name, read_csv(path, mapping.delimiter, mapping.names(), mapping.time)
    )


def _is_csv(path: Path) -> bool:
    return path.is_file() and path.name.endswith((".csv", ".csv.gz"))

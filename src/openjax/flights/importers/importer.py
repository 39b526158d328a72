"""The list of importers. Each recognises its own files and reads them as a `LogTable`.

The shipped ones are in a list like any other; a program of yours adds one by `register`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openjax.errors import part_name
from openjax.flights.importers.columns import ColumnMapping
from openjax.flights.reading import LogError, LogTable


@dataclass(frozen=True)
class Importer:
    """A reader of logs of one format."""

    name: str
    """Of the format, in words."""
    matches: Callable[[Path], bool]
    """matches(path): whether a file or folder of a case is such a log. It is asked of everything in
    the folder, so it looks at the name or at the first bytes, and never raises.
    """
    read: Callable[[Path, ColumnMapping | None], LogTable]
    """read(path, mapping): the log in the log format's columns and units. `mapping` is
    what the case's `columns.toml` says, None without one. Raises LogError, in one line,
    for a log that can't be read.
    """


_IMPORTERS: list[Importer] = []


def register(importer: Importer) -> Importer:
    """Add an importer, which is asked before those that are there already; one of the
    same name takes the other's place. Returns it.
    """
    _IMPORTERS[:] = [importer, *(other for other in _IMPORTERS if other.name != importer.name)]
    return importer


def importers() -> tuple[Importer, ...]:
    """All importers, in the order in which they are asked."""
    return tuple(_IMPORTERS)


def importer_of(path: Path) -> Importer | None:
    """The first importer that knows a file or folder; None where none does."""
    return next((importer for importer in _IMPORTERS if importer.matches(path)), None)


def check_table(name: str, table: Any) -> LogTable:
    """The table that the importer of that name has read. Raises LogError unless it is a table whose
    columns all have a row for each vehicle's id.
    """
    if not isinstance(table, LogTable):
        raise LogError(
            f"the importer of {name} gives {part_name(table)}; a LogTable would be right"
        )
    rows = np.shape(table.vehicle)
    for column, values in table.columns.items():
        if not isinstance(values, np.ndarray) or values.shape != rows:
            raise LogError(
                f"the importer of {name} gives column {column} as {part_name(values)} of "
                f"shape {np.shape(values)}; an array of shape {rows}, a row for each id in "
                "vehicle, would be right"
            )
    return table

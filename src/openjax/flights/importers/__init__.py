"""Importers: logs of other formats become the same table as a CSV of the log format.

A case folder may hold logs of several formats side by side. A `columns.toml` in the
folder says which of their columns is what, where the names aren't the usual ones. A
format of your own is an `Importer` that you `register`.
"""

from pathlib import Path

from openjax.errors import UserError
from openjax.flights.importers import (
    ardupilot,
    betaflight,
    crazyflie,
    log_format,
    micro_sd,
    px4,
    ros2,
    topic_times,
)
from openjax.flights.importers.columns import MAPPING_FILE, ColumnMapping, load_mapping
from openjax.flights.importers.importer import (
    Importer,
    check_table,
    importer_of,
    importers,
    register,
)
from openjax.flights.reading import LogError, LogTable

__all__ = [
    "MAPPING_FILE",
    "ColumnMapping",
    "Importer",
    "find_logs",
    "importers",
    "load_mapping",
    "read_log",
    "register",
]

HIDDEN = (".", "~$")

# The last that is registered is the first that is asked: a CSV that no other one knows is taken for
# one of the log format, and a layout with several time stamps may hold a firmware's names.
for _importer in (
    log_format.IMPORTER,
    crazyflie.IMPORTER,
    betaflight.CSV_IMPORTER,
    topic_times.IMPORTER,
    betaflight.BINARY_IMPORTER,
    px4.IMPORTER,
    ardupilot.IMPORTER,
    micro_sd.IMPORTER,
    ros2.IMPORTER,
):
    register(_importer)


def find_logs(folder: Path) -> list[Path]:
    """The logs of a case folder, by name."""
    # hidden files aren't logs: macOS leaves one beside each file that it copies, a
    # spreadsheet beside each that is open
    files = (path for path in folder.iterdir() if not path.name.startswith(HIDDEN))
    logs = (path for path in files if not betaflight.is_beside(path))
    return sorted(path for path in logs if importer_of(path) is not None)


def read_log(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """One log of any known format as a table. Raises LogError if it can't be read."""
    importer = importer_of(path)
    if importer is None:
        formats = ", ".join(importer.name for importer in importers())
        raise LogError(f"no known format; known are {formats}")
    try:
        table = importer.read(path, mapping)
    except UserError:
        raise
    except Exception as error:  # a damaged file fails wherever its damage is first met
        words = (str(error).splitlines() or [""])[0]
        raise LogError(
            f"can't be read as {importer.name} ({type(error).__name__}: {words}): damaged?"
        ) from error
    return check_table(importer.name, table)

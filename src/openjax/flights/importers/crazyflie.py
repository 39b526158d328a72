"""CSV files with the firmware's names: what the Crazyflie's client writes of a log block, and what
scripts with cflib write.

The client's `LogWriter` puts the firmware's tick in ms into a column `Timestamp` and one file per
log block; scripts call it `timestamp` or `tick`. Files of several blocks of one flight, which have
the same ticks, may lie in one folder of the case: they are one log.
"""

from pathlib import Path

import numpy as np

from openjax.flights.importers.columns import ColumnMapping
from openjax.flights.importers.csv_files import (
    delimiter_of,
    header_of,
    is_csv,
    is_log_format,
    raw_columns,
    seconds_per_unit,
)
from openjax.flights.importers.firmware import (
    VARIABLES,
    are_duty_cycles,
    firmware_columns,
    with_mixer,
)
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import LogError, LogTable

TIME_NAMES = ("timestamp", "tick", "ticks", "time", "time_ms", "timestamp_ms", "t")
GROUPS = ("stateEstimate", "stateEstimateZ", "stabilizer", "kalman", "gyro", "acc", "controller")
"""Of log variables whose names no other program has; other programs have a `motor.m1`, too."""
SINCE_1970 = 1e9  # s, from which stamps count since then
SELDOM = 2000.0  # ms between rows: the slowest log block of the firmware has 2550


def is_block(path: Path) -> bool:
    """True if a CSV holds a time and log variables of the firmware."""
    names = header_of(path)
    variables = VARIABLES.intersection(names)
    evident = {name.partition(".")[0] for name in variables} & set(GROUPS)
    # A log block of motors or of the battery alone has nothing else to be known by.
    has_time = variables and len(variables) == len(names) - 1
    return bool((evident or has_time) and time_name(names) and not is_log_format(names))


def is_client_log(path: Path) -> bool:
    """True if a path is such a CSV, or a folder of one flight's log blocks; a note
    may lie beside.
    """
    if path.is_dir():
        inside = _blocks(path)
        return len(inside) > 1 and all(map(is_block, inside))
    return is_block(path)


def _blocks(folder: Path) -> list[Path]:
    """A folder's CSV files."""
    return [file for file in sorted(folder.iterdir()) if is_csv(file)]


def time_name(names: list[str]) -> str | None:
    """The column that holds the time: the firmware's own rather than the computer's."""
    candidates = [name for name in names if name.lower() in TIME_NAMES]
    return min(candidates, key=lambda name: TIME_NAMES.index(name.lower()), default=None)


def read_client_log(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """A flight's log blocks. Raises LogError where they hold nothing that can be used."""
    files = _blocks(path) if path.is_dir() else [path]
    streams = []
    remarks = []
    for file in files:
        try:
            stream, more_remarks = _block(file, mapping)
        except LogError as error:
            if len(files) == 1:
                raise
            remarks.append(f"{file.name}: {error}: left out")
            continue
        streams.append(with_mixer(stream))
        remarks += more_remarks
    columns, more_remarks = firmware_columns(streams, mapping)
    table = merge_streams(streams, columns)
    start = float(table["t"][0])
    table["t"] = table["t"] - start
    # a computer's clock; ticks count from when the vehicle was switched on
    clock_start = start if start > SINCE_1970 else None
    vehicle = np.full(len(table["t"]), "0")
    remarks = (*remarks, *more_remarks)
    return LogTable(path.name, table, vehicle, remarks, are_duty_cycles(columns), clock_start)


def _block(path: Path, mapping: ColumnMapping | None) -> tuple[Stream, list[str]]:
    """One file as a stream, time in seconds since the firmware started, and remarks."""
    delimiter = delimiter_of(mapping)
    names = header_of(path, delimiter)
    mapping_columns = {} if mapping is None else mapping.columns
    time = mapping_columns["t"].name if "t" in mapping_columns else time_name(names)
    if time is None:
        raise LogError(f"no column {' or '.join(TIME_NAMES[:2])}: which holds the ticks in ms?")
    variables = (time, *VARIABLES, *(source.name for source in mapping_columns.values()))
    values, remarks = raw_columns(path, variables, time, delimiter)
    ticks = values.pop(time)
    scale = mapping_columns["t"].scale if "t" in mapping_columns else _tick(ticks)
    return Stream(scale * ticks, values), remarks


def _tick(ticks: np.ndarray) -> float:
    """Seconds of a tick: a ms in the firmware, so that a block that is logged once a second has
    steps of 1000; where rows are further apart, or not whole numbers, what the steps look like.
    """
    steps = np.diff(np.unique(ticks[np.isfinite(ticks)]))
    is_whole = len(steps) and not (steps % 1.0).any()
    return 1e-3 if is_whole and np.median(steps) <= SELDOM else seconds_per_unit(ticks)


IMPORTER = Importer("CSV of the Crazyflie's client or cflib", is_client_log, read_client_log)

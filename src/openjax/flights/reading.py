"""A log as a table of columns, whatever its format was, and the flights in it.

Importers of all formats make the same table, so that everything behind it is shared.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from openjax.flights.csv_text import LogError
from openjax.flights.flight import CHANNEL_COLUMNS, Flight

LOG_COLUMNS = ("t", "vehicle", *(c for columns in CHANNEL_COLUMNS.values() for c in columns))

# channels of which a part is a mistake, not a choice
WHOLE = ("quaternion", "motor_command", "rotor_speed")
OF_ROTORS = ("motor_command", "rotor_speed")
MOST_VEHICLES = 200  # swarms are of tens
NAMES_SHOWN = 12  # of columns in one message
LONGEST_NAME = 40  # characters of a name or a cell in a message
# no sensor's reading in SI units is larger; squares of what is would overflow
LARGEST_VALUE = 1e6


@dataclass(frozen=True, eq=False)
class LogTable:
    """One log file as columns of the log format."""

    name: str
    columns: dict[str, np.ndarray]
    """{name: (R,) float64}, NaN where a cell was empty."""
    vehicle: np.ndarray
    """(R,) ids."""
    remarks: tuple[str, ...] = field(default=())
    """Remarks made while reading, which don't stop it."""
    duty_cycles: bool = False
    """True if the format says that m1 to m4 are duty cycles."""
    clock_start: float | None = None
    """The log's clock at t = 0, s: since 1970, or since the flight's start; None
    for a clock of the vehicle's own.
    """


def flights_of(
    table: LogTable, motor_permutation: tuple[int, ...] = (0, 1, 2, 3)
) -> tuple[list[Flight], list[str]]:
    """The table's flights, one per vehicle, as logged (not yet sorted, checked or cut), motors in
    the nominal order; and remarks on columns that couldn't be used. Raises LogError without time.
    """
    if "t" not in table.columns:
        raise LogError(
            f"no column t; the log has {name_list(table.columns)}: name it in columns.toml"
        )
    remarks = list(table.remarks)
    all_channels = {c: _channel(table, c, names, remarks) for c, names in CHANNEL_COLUMNS.items()}
    channels = {c: v for c, v in all_channels.items() if v is not None}
    for channel in set(OF_ROTORS) & set(channels):
        channels[channel] = channels[channel][:, list(motor_permutation)]
    # of all vehicles at once: a copy of a log is one of all of its flights
    fingerprint = _fingerprint(channels)
    ids = list(dict.fromkeys(table.vehicle.tolist()))
    if len(ids) > MOST_VEHICLES:
        raise LogError(
            f"column vehicle holds {len(ids)} ids, {name_list(ids, 3)}; it names which vehicle a "
            "row belongs to"
        )
    flights = []
    for vehicle_id in ids:
        rows = np.flatnonzero(table.vehicle == vehicle_id)
        # in the long format a vehicle's rows hold what it logged, and nothing of the others'
        arrays = {c: v[rows] for c, v in channels.items() if not np.isnan(v[rows]).all()}
        name = table.name if len(ids) == 1 else f"{table.name}:{vehicle_id}"
        time = table.columns["t"][rows]
        facts = {n: getattr(table, n) for n in ("duty_cycles", "clock_start")}
        facts["fingerprint"] = fingerprint
        flights.append(Flight(name, table.name, vehicle_id, time, **facts, **arrays))
    return flights, remarks


def _channel(table: LogTable, channel: str, names, remarks: list[str]) -> np.ndarray | None:
    """(T,) or (T, columns) of one channel; None where it wasn't logged."""
    present = [n for n in names if n in table.columns]
    if len(present) < len(names):
        absent = ", ".join(n for n in names if n not in table.columns)
        if present and channel in WHOLE:
            hint = "; motors are counted from 1" * (absent in ("m4", "w4"))
            raise LogError(
                f"{', '.join(present)} without {absent}: log {absent}, or none of them{hint}"
            )
        if present:
            remarks.append(
                f"{', '.join(present)} without {absent}: {channel} is left out; log {absent}"
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


def name_list(names: Iterable[str], most: int = NAMES_SHOWN) -> str:
    """The first names, and how many more there are."""
    names = [name[:LONGEST_NAME] for name in names]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _fingerprint(channels: dict[str, np.ndarray]) -> str:
    """Hash of the values without time or file layout, so that a renamed, shifted or
    repacked copy is the same.
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

"""What a flight leaves behind: a case that `openjax diagnose` reads, and `flight.json`
about the flight.

One log per game, with all vehicles in it: a row for each moment at which something was
sampled on board. Commands are those in force at that moment, as sent: body rates and
thrust.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openjax.flights.csv_table import write_csv
from openjax.flights.reading import CHANNEL_COLUMNS, LogTable
from openjax.flights.samples import log_of
from openjax.flying.flight_record import FlightRecord
from openjax.flying.member import Samples
from openjax.flying.set_point import RATES
from openjax.vehicle.vehicle_file import VehicleFile, save_vehicle_file

SHORTEST = 2.0
"""Shorter games (s) tell a diagnosis nothing and get no log."""
DECIMALS = {"t": 4, "vbat": 3}  # others have six
_POSE = (
    *CHANNEL_COLUMNS["position"],
    *CHANNEL_COLUMNS["velocity"],
    *CHANNEL_COLUMNS["quaternion"],
    *CHANNEL_COLUMNS["body_rates"],
)
"""Of a `Pose`'s 13 numbers, in their order."""
_BODY = CHANNEL_COLUMNS["motor_command"] + CHANNEL_COLUMNS["specific_force"]
_COMMAND = CHANNEL_COLUMNS["command_thrust"] + CHANNEL_COLUMNS["command_body_rates"]


def write_case(
    folder: Path, samples, record: FlightRecord, vehicle: VehicleFile, about: dict
) -> list[Path]:
    """Write the case: one log per game long enough, vehicle.toml, flight.json. Returns
    the files.

    Args:
      folder: to write to; it must exist.
      samples: what was recorded of each vehicle, see `openjax.flying.member.Samples`.
      record: of the loop.
      vehicle: what flew, for all I know.
      about: what flight.json is to say beside timing and games.
    """
    table, vehicles = record.table()
    _, sent_at, episode = table.T
    commands = vehicles[..., 2:]
    games = []
    for number in range(len(record.episodes)):
        ticks = np.flatnonzero(episode == number)
        if not len(ticks) or sent_at[ticks[-1]] - sent_at[ticks[0]] < SHORTEST:
            continue
        games.append((folder / f"game_{number:02d}.csv.gz", ticks))

    def write(game):
        path, ticks = game
        write_csv(path, _table(path.name, samples, sent_at[ticks], commands[ticks]), DECIMALS)
        return path

    # half of the time is zlib's, which lets others run
    with ThreadPoolExecutor(4) as pool:
        files = list(pool.map(write, games))
    save_vehicle_file(folder / "vehicle.toml", vehicle)
    text = json.dumps({**about, "timing": record.timing(), "games": record.episodes}, indent=1)
    (folder / "flight.json").write_text(text + "\n", encoding="utf-8")
    return [*files, folder / "vehicle.toml", folder / "flight.json"]


def _table(name: str, samples, sent_at: np.ndarray, commands: np.ndarray) -> LogTable:
    """One game's log.

    Args:
      name: of the file.
      samples: as of `write_case`.
      sent_at: (T,) s, when the set-points of each tick had left.
      commands: (T, N, 5) of them: mode, thrust, body rates.
    """
    rows = [_rows(vehicle, sent_at, commands[:, i]) for i, vehicle in enumerate(samples)]
    log = log_of(rows, name)
    # a column that nobody filled in would say that there was such a sensor
    columns = {n: column for n, column in log.columns.items() if not np.isnan(column).all()}
    return LogTable(name, columns, log.vehicle)


class _Source(NamedTuple):
    """What one sensor or log block gave."""

    time: np.ndarray
    """(K,) s"""
    names: tuple[str, ...]
    """Columns."""
    values: np.ndarray
    """(K, columns)"""

    def during(self, first: float, last: float) -> "_Source":
        """What was measured from `first` to `last` (s), times as a log writes them."""
        time = np.round(self.time, 4)
        inside = (time >= first) & (time <= last)
        return _Source(time[inside], self.names, self.values[inside])


def _sources(vehicle: Samples) -> list[_Source]:
    """All that was recorded of a vehicle; what comes later replaces what came
    before.
    """
    own_poses = np.column_stack([vehicle.poses[:, 3:], vehicle.poses[:, 1]])
    poses = _Source(vehicle.poses[:, 2], (*_POSE, "vbat"), own_poses)
    bodies = _Source(vehicle.bodies[:, 0], _BODY, vehicle.bodies[:, 1:])
    if not len(vehicle.seen):
        return [poses, bodies]
    # motion capture in place of the estimate on board, of which body rates and voltage
    # stay
    poses = _Source(poses.time, poses.names[10:], own_poses[:, 10:])
    capture = _Source(vehicle.seen[:, 0], _POSE[:10], vehicle.seen[:, 1:11])
    return [poses, bodies, capture]


def _rows(vehicle: Samples, sent_at, commands) -> dict[str, np.ndarray]:
    """The rows of one vehicle, by column: one for each moment at which something was
    measured.
    """
    sources = [source.during(sent_at[0], sent_at[-1]) for source in _sources(vehicle)]
    times = np.unique(np.concatenate([source.time for source in sources]))
    rows = {n: np.full(len(times), np.nan) for n in ("t", *_POSE, *_BODY, *_COMMAND, "vbat")}
    rows["t"] = times - sent_at[0]
    for source in sources:
        at = np.searchsorted(times, source.time)
        for n, column in zip(source.names, source.values.T, strict=True):
            rows[n][at] = column
    # in force at a moment is what left last before it
    command = commands[np.maximum(np.searchsorted(sent_at, times, side="right") - 1, 0)]
    # angles and motors off are no commanded body rates: their cells stay empty
    is_rates = command[:, 0] == RATES
    for n, column in zip(_COMMAND, command[:, 1:].T, strict=True):
        rows[n][is_rates] = column[is_rates]
    return rows

"""What a flight leaves behind: a case that `openjax diagnose` reads, and `flight.json` about the
flight.

One log per game, with all vehicles in it: a row for each moment at which something was sampled on
board. Commands are those in force at that moment, as sent: body rates and thrust.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from openjax.flights.reading import CHANNEL_COLUMNS, LogTable, write_csv
from openjax.flights.samples import log_of
from openjax.flying.loop import Record
from openjax.flying.set_point import RATES
from openjax.flying.swarm import Samples
from openjax.vehicle.vehicle_file import VehicleFile, save_vehicle_file

SHORTEST = 2.0
"""Shorter games (s) tell a diagnosis nothing and get no log."""
DECIMALS = {"t": 4, "vbat": 3}
_POSE = tuple(
    c
    for channel in ("position", "velocity", "quaternion", "body_rates")
    for c in CHANNEL_COLUMNS[channel]
)
"""Of a `Pose`'s 13 numbers, in their order."""
_BODY = CHANNEL_COLUMNS["motor_command"] + CHANNEL_COLUMNS["specific_force"]
_COMMAND = CHANNEL_COLUMNS["command_thrust"] + CHANNEL_COLUMNS["command_body_rates"]


def write_case(
    folder: Path, samples, record: Record, vehicle: VehicleFile, about: dict
) -> list[Path]:
    """Write the case: one log per game long enough, vehicle.toml, flight.json. Returns the files.

    Args:
      folder: to write to; it must exist.
      samples: what was recorded of each vehicle, see `openjax.flying.swarm.Samples`.
      record: of the loop.
      vehicle: what flew, for all I know.
      about: what flight.json is to say beside timing and games.
    """
    table, vehicles = record.table()
    _, sent, episode = table.T
    commands = vehicles[..., 2:]
    files = []
    for number in range(len(record.episodes)):
        ticks = np.flatnonzero(episode == number)
        if not len(ticks) or sent[ticks[-1]] - sent[ticks[0]] < SHORTEST:
            continue
        files.append((folder / f"game_{number:02d}.csv.gz", ticks))

    def write(path, ticks):
        write_csv(path, _table(path.name, samples, sent[ticks], commands[ticks]), DECIMALS)
        return path

    with ThreadPoolExecutor(4) as pool:  # half of the time is zlib's, which lets others run
        files = list(pool.map(lambda file: write(*file), files))
    save_vehicle_file(folder / "vehicle.toml", vehicle)
    text = json.dumps({**about, "timing": record.timing(), "games": record.episodes}, indent=1)
    (folder / "flight.json").write_text(text + "\n", encoding="utf-8")
    return [*files, folder / "vehicle.toml", folder / "flight.json"]


def _table(name: str, samples, sent: np.ndarray, commands: np.ndarray) -> LogTable:
    """One game's log.

    Args:
      name: of the file.
      samples: as of `write_case`.
      sent: (T,) s, when the set-points of each tick had left.
      commands: (T, N, 5) of them: mode, thrust, body rates.
    """
    log = log_of([_rows(vehicle, sent, commands[:, i]) for i, vehicle in enumerate(samples)], name)
    return LogTable(
        name, {n: c for n, c in log.columns.items() if not np.isnan(c).all()}, log.vehicle
    )


def _rows(vehicle: Samples, sent, commands) -> dict[str, np.ndarray]:
    """The rows of one vehicle, by column: one for each moment at which something was measured."""
    own = vehicle.poses[:, 3:]
    seen = vehicle.seen[:, 1:]
    sources = [  # when, columns, values; what comes later replaces what came before
        (vehicle.poses[:, 2], (*_POSE, "vbat"), np.column_stack([own, vehicle.poses[:, 1]])),
        (vehicle.bodies[:, 0], _BODY, vehicle.bodies[:, 1:]),
    ]
    if len(seen):  # motion capture in place of the estimate on board
        sources[0] = (sources[0][0], (*_POSE[10:], "vbat"), sources[0][2][:, 10:])
        sources.append((vehicle.seen[:, 0], _POSE[:10], seen[:, :10]))
    inside = []
    for when, names, values in sources:
        when = np.round(when, 4)
        during = (when >= sent[0]) & (when <= sent[-1])
        inside.append((when[during], names, values[during]))
    times = np.unique(np.concatenate([when for when, _, _ in inside]))
    rows = {n: np.full(len(times), np.nan) for n in ("t", *_POSE, *_BODY, *_COMMAND, "vbat")}
    rows["t"] = times - sent[0]
    for when, names, values in inside:
        at = np.searchsorted(times, when)
        for n, column in zip(names, values.T, strict=True):
            rows[n][at] = column
    command = commands[np.maximum(np.searchsorted(sent, times, side="right") - 1, 0)]
    rated = command[:, 0] == RATES
    for n, column in zip(_COMMAND, command[:, 1:].T, strict=True):
        rows[n][rated] = column[rated]
    return rows

"""What a flight leaves behind: a case that `openjax diagnose` reads, and `flight.json` about the flight.

One log per game, with all vehicles in it: a row for each moment at which something was sampled on board. Commands are
those in force at that moment, as sent: body rates and thrust.
"""

from __future__ import annotations

import bisect
import json
import math
from pathlib import Path

import numpy as np

from openjax.flights.reading import CHANNEL_COLUMNS, LogTable, write_csv
from openjax.flying.loop import Record, measured_numbers
from openjax.flying.set_point import RATES
from openjax.vehicle.vehicle_file import VehicleFile, save_vehicle_file

SHORTEST = 2.0
"""Shorter games (s) tell a diagnosis nothing and get no log."""
DECIMALS = {"t": 4, "vbat": 3}
_POSE = tuple(
    c for channel in ("position", "quaternion", "velocity", "body_rates") for c in CHANNEL_COLUMNS[channel]
)
_BODY = CHANNEL_COLUMNS["motor_command"] + CHANNEL_COLUMNS["specific_force"]
_COMMAND = CHANNEL_COLUMNS["command_thrust"] + CHANNEL_COLUMNS["command_body_rates"]


def write_case(folder: Path, samples, record: Record, vehicle: VehicleFile, about: dict) -> list[Path]:
    """Write the case: one log per game long enough, vehicle.toml, flight.json. Returns the files.

    Args:
      folder: to write to; it must exist.
      samples: what was recorded of each vehicle, see `openjax.flying.swarm.Samples`.
      record: of the loop.
      vehicle: what flew, for all I know.
      about: what flight.json is to say beside timing and games.
    """
    files = []
    for number in range(len(record.episodes)):
        ticks = [k for k, episode in enumerate(record.episode) if episode == number]
        if not ticks or record.sent[ticks[-1]] - record.sent[ticks[0]] < SHORTEST:
            continue
        path = folder / f"game_{number:02d}.csv.gz"
        write_csv(path, _table(path.name, samples, record, ticks), DECIMALS)
        files.append(path)
    save_vehicle_file(folder / "vehicle.toml", vehicle)
    text = json.dumps({**about, "timing": record.timing(), "games": record.episodes}, indent=1)
    (folder / "flight.json").write_text(text + "\n", encoding="utf-8")
    return [*files, folder / "vehicle.toml", folder / "flight.json"]


def _table(name, samples, record, ticks) -> LogTable:
    """One game's log."""
    begin, end = record.sent[ticks[0]], record.sent[ticks[-1]]
    sent = [record.sent[k] for k in ticks]
    rows, ids = [], []

    def within(samples, time_of):
        """(time, sample) of those in this game."""
        times = ((round(time_of(sample), 4), sample) for sample in samples)
        return [(at, sample) for at, sample in times if begin <= at <= end]

    for i, vehicle in enumerate(samples):
        at_time: dict[float, dict] = {}
        for at, (_, pose, voltage) in within(vehicle.poses, lambda sample: sample[1].time):
            values = dict(zip(_POSE, measured_numbers(pose), strict=True))
            if vehicle.seen:
                values = {name: values[name] for name in _POSE[10:]}
            at_time.setdefault(at, {}).update(values, vbat=voltage)
        # motion capture in place of the estimate on board
        for at, pose in within(vehicle.seen, lambda pose: pose.time):
            at_time.setdefault(at, {}).update(zip(_POSE[:10], measured_numbers(pose)[:10], strict=True))
        for at, (_, values) in within(vehicle.bodies, lambda sample: sample[0]):
            at_time.setdefault(at, {}).update(zip(_BODY, values, strict=True))
        for at in sorted(at_time):
            command = record.set_points[ticks[max(bisect.bisect_right(sent, at) - 1, 0)]][i]
            row = at_time[at]
            if command.mode == RATES:
                numbers = (command.thrust, command.roll, command.pitch, command.yaw_rate)
                row.update(zip(_COMMAND, numbers, strict=True))
            rows.append({"t": at - begin, **row})
            ids.append(str(i))
    order = sorted(range(len(rows)), key=lambda k: (rows[k]["t"], ids[k]))
    names = ("t", *_POSE, *_BODY, *_COMMAND, "vbat")
    columns = {n: np.array([rows[k].get(n, math.nan) for k in order]) for n in names}
    columns = {n: c for n, c in columns.items() if not np.isnan(c).all()}
    return LogTable(name, columns, np.array([ids[k] for k in order]))

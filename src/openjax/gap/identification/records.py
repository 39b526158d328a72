"""Stretches of flights at the log's own rate, as an identification needs them.

The replay of the diagnosis runs on a grid of 10 ms. What motors do is seen best at the
rate of the loop that commands them, so here faster logs keep their rows, down to 2 ms.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from openjax.flights.flight import Case, Flight
from openjax.flights.track import (
    MAX_GAP,
    MIN_DURATION,
    MISSED_SAMPLES,
    held_means,
    pwm_thrust,
    smooth,
)
from openjax.vehicle.parameters import hover_share

# s, the period of the firmware's rate loop: faster rows hold nothing new
SHORTEST = 0.002
CARRIED = 0.5  # of the hovering thrust: below, the floor carries
TAKE_OFF = 1.0  # s
TORQUES = ("motor_command", "body_rates")
# s between holes; its first quarter only tells what was before the rest
SHORTEST_PART = 1.0
LOOP_ROWS = 0.003  # s: rows as short show every cycle of the rate loop


@dataclass(frozen=True, eq=False)
class Record:
    """T rows of `dt` s. `motor` (T, 4): thrust commanded, as shares of the largest,
    held from a row's time to the next; channels that weren't logged are None.
    """

    flight: str
    dt: float
    rates: np.ndarray  # (T, 3) rad/s
    motor: np.ndarray  # (T, 4)
    force: np.ndarray | None  # (T, 3) m/s^2, body
    velocity: np.ndarray | None  # (T, 3) m/s, world
    quaternion: np.ndarray | None  # (T, 4)
    voltage: np.ndarray | None  # (T,) V
    vehicle: object
    # a row's motors are one sample of a faster loop, not the mean over the row
    samples: bool
    # lines stand for motors or body rates that weren't logged
    bridges_holes: bool = False

    def rows(self, rows: slice) -> "Record":
        """The record with some of its rows."""
        cut = {
            f.name: getattr(self, f.name)[rows]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **cut)

    @property
    def hides_ticks(self) -> bool:
        """Whether the rate loop ran several times within a row."""
        return self.dt > LOOP_ROWS


def records_of(case: Case) -> list[Record]:
    """All stretches of a case's flights with body rates and motor commands."""
    records = []
    for flight in case.flights:
        if not flight.has_motors or flight.body_rates is None or flight.body_rates_derived:
            continue
        holes = flight.in_holes(TORQUES, MAX_GAP, MISSED_SAMPLES)
        parts = _records(flight.rows(~holes), flight, case, SHORTEST_PART)
        if not parts:
            parts = [
                replace(r, bridges_holes=bool(holes.any())) for r in _records(flight, flight, case)
            ]
        records += parts
    # One estimator reads rows of one period: the one that holds most of the flights.
    periods = [r.dt for r in records for _ in range(len(r.rates))]
    usual = max(set(periods), key=periods.count) if periods else 0.0
    return [r for r in records if r.dt == usual]


def _records(rows: Flight, flight: Flight, case: Case, least: float = MIN_DURATION):
    """Records of the stretches, at least so many s long, of some `rows` of a flight.
    Lines over longer gaps than these would make motors look quicker or slower, by a
    tenth to a fifth.
    """
    records = []
    for stretch in rows.stretches(max(MAX_GAP, MISSED_SAMPLES * flight.row_period), least):
        records += _in_the_air(_record(rows.rows(stretch), flight, case), least)
    return records


def _in_the_air(record: Record, least: float) -> list[Record]:
    """The parts of a record in which the motors carry the vehicle, without its take-off
    and landing.
    """
    hover = float(hover_share(record.vehicle))
    airborne = smooth(record.motor.mean(1), 0.5, record.dt) > CARRIED * hover
    edges = np.flatnonzero(np.diff(np.concatenate([[False], airborne, [False]]).astype(int)))
    away = round(TAKE_OFF / record.dt)
    parts = []
    for begin, end in edges.reshape(-1, 2):
        begin += away * (begin > 0)
        end -= away * (end < len(airborne))
        if (end - begin) * record.dt >= least:
            parts.append(record.rows(slice(begin, end)))
    return parts


def _record(part: Flight, flight: Flight, case: Case) -> Record:
    dt = max(round(flight.row_period, 4), SHORTEST)
    grid = np.arange(part.time[0], part.time[-1] - dt, dt)
    at, motors = part.sampled("motor_command")
    motor = np.stack([held_means(at, column, grid, dt) for column in motors.T], 1)
    voltage = None
    if part.battery_voltage is not None:
        voltage = smooth(part.interpolated("battery_voltage", grid), 0.3, dt)
    vehicle = case.vehicle_of(flight)
    if case.vehicle_file.motor.command == "pwm":
        motor = pwm_thrust(motor, voltage, vehicle)

    def channel(name):
        return None if getattr(part, name) is None else part.interpolated(name, grid)

    return Record(
        flight=flight.log,
        dt=dt,
        rates=channel("body_rates"),
        motor=motor,
        force=channel("specific_force"),
        velocity=channel("velocity"),
        quaternion=channel("quaternion"),
        voltage=voltage,
        vehicle=vehicle,
        samples=case.vehicle_file.log.get("motor_rows", "mean") == "sample",
    )

"""Flights put on even clocks, as tracks.

Replays step from row to row, so a flight is put on an even time grid once: rows between 100 Hz and
50 Hz are kept, faster logs are averaged down to 100 Hz, and a longer gap splits a flight into two
tracks.

What motors do is seen best at the rate of the loop that commands them, so for an identification
faster logs keep their rows, down to 2 ms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from openjax.flights.flight import HOLE, SENSORS, Case, Flight
from openjax.flights.sampling import runs_of
from openjax.flights.shapes import Motors, Times
from openjax.flights.track import GRAVITY, Array, Track, smooth

GRID_PERIOD = 0.01  # s, the step of the simulator
MIN_DURATION = 2.0  # s, shorter stretches say next to nothing and are left out
CHANNELS = (*SENSORS, "motor_command", "command_thrust", "command_body_rates")
MAX_GAP = 0.05  # s, a longer step between rows splits the flight
MISSED_SAMPLES = 3.0  # and a channel that misses more than so many has a hole
SPARSE = 0.8  # periods between samples of a channel that comes no faster than the clock
RHYTHM = 50  # new commands from which their rhythm is looked for
RHYTHMIC = 0.5  # concentration of their phases (0 to 1) from which they have one
EARLY = 25.0  # per cent of them that may come before the rows that are made for them
# s, the period of the firmware's rate loop: faster rows hold nothing new
FASTEST_ROW = 0.002
TORQUES = ("motor_command", "body_rates")
# s between holes; its first quarter only tells what was before the rest
SHORTEST_PART = 1.0
TAKE_OFF = 1.0  # s after a take-off and before a landing in which the floor still acts


def tracks_of(case: Case) -> list[Track]:
    """All usable stretches of a case's flights, in the case's order."""
    return [track for flight in case.flights for track in flight_tracks(flight, case)]


def flight_tracks(flight: Flight, case: Case) -> list[Track]:
    """The stretches of one flight without gaps, on a uniform grid. A long hole in a
    channel is one, too, unless nothing is left without.
    """
    without_holes = flight.rows(~flight.in_holes(CHANNELS))
    return _stretches(without_holes, flight, case) or _stretches(flight, flight, case)


def _stretches(flight: Flight, without_holes: Flight, case: Case) -> list[Track]:
    """Tracks of rows of a flight as it was `logged`."""
    tracks = []
    for number, stretch in enumerate(
        flight.stretches(max_step=max(MAX_GAP, 3 * flight.row_period), min_duration=MIN_DURATION)
    ):
        part = _between_poses(flight.rows(stretch))
        tracks.append(
            _on_grid(
                part, without_holes, case, f"{flight.name}#{number}" if number else flight.name
            )
        )
    return tracks


def _between_poses(part: Flight) -> Flight:
    """The rows from the first place to the last one: beyond, where a line would be held,
    the body isn't known and would stand still for a row or two.
    """
    if part.position is None or not len(at := part.sampled("position")[0]):
        return part
    if max(at[0] - part.time[0], part.time[-1] - at[-1]) > HOLE:
        return part  # a hole, which is told elsewhere
    return part.rows((part.time >= at[0]) & (part.time <= at[-1]))


def _grid_of(part):
    """Period (s) of the clock that a stretch is read on, whether its rows come faster,
    and the clock's times (G,).
    """
    period = max(part.row_period, GRID_PERIOD)
    # rows about as far apart as the grid's are taken for the grid's: one filter and one
    # compiled program for all of them
    if abs(period - GRID_PERIOD) < 0.15 * GRID_PERIOD:
        period = GRID_PERIOD
    faster = period / part.row_period > 1.2
    begin = part.time[0] + (_command_phase(part, period) if faster else 0.0)
    # the last row counts, whatever a quotient of floats makes of it
    count = int((part.time[-1] - begin) / period + 1e-6) + 1
    return period, faster, begin + period * np.arange(count)


def _neighbours(case, flight, grid):
    """(M, G, 3) m, where the other vehicles are that were tracked."""
    places = [
        other.interpolated("position", grid)
        for other in case.others(flight)
        if other.position is not None
    ]
    return np.array(places) if places else np.zeros((0, len(grid), 3))


def _command(take):
    """(G, 4) thrust and body rates; `take` gives a channel's values on the clock."""
    thrust = take("command_thrust", ahead=True)
    return np.concatenate([thrust[:, None], take("command_body_rates", ahead=True)], 1)


def _sensors(take, floor):
    """Each sensor's readings on the clock, by its name. Heights count from the floor, since the
    vehicle feels its cushion.
    """
    sensors = {sensor: take(sensor) for sensor in SENSORS}
    if sensors["position"] is not None:
        sensors["position"] = sensors["position"] - floor
    return sensors


def _reader_of(part: Flight, period: float, faster: bool, grid: Array):
    """A function that gives the values of a channel of a stretch on the clock; None where it
    wasn't logged. Those `ahead` hold until the next row.
    """

    def take(channel: str, ahead: bool = False) -> Array | None:
        if getattr(part, channel) is None:
            return None
        # a pose at a moment is its place on the line; a mean of attitudes is none
        if not faster or channel in ("position", "quaternion"):
            return part.interpolated(channel, grid)
        # Faster logs: the mean around a grid point; of commands, which hold until the
        # next row, the mean that follows it.
        at, values = part.sampled(channel)
        flat = values.reshape(len(values), -1)
        if channel == "body_rates" and np.median(np.diff(at)) > SPARSE * period:
            # lines between samples as far apart as the clock's would take a tenth off a
            # quick turn, and a rate loop would seem to answer more than it was told
            curve = CubicSpline(at, flat)
            at = np.arange(at[0], at[-1], part.row_period)
            flat = curve(at)
        means = _means(at, flat, grid if ahead else grid - 0.5 * period, period, ahead)
        return means.reshape((len(grid), *values.shape[1:]))

    return take


def _on_grid(part: Flight, flight: Flight, case: Case, name: str) -> Track:
    """A stretch of a flight on an even clock."""
    period, faster, grid = _grid_of(part)
    take = _reader_of(part, period, faster, grid)
    motor = take("motor_command", ahead=True)
    voltage = take("battery_voltage")
    fast_thrust = None
    if motor is not None and case.vehicle_file.motor.command == "pwm":
        motor = pwm_thrust(motor, voltage, case.vehicle_of(flight))
    # single commands show in rows that are faster than the grid
    elif motor is not None and faster:
        at, values = part.sampled("motor_command")
        fast_thrust = at, values.mean(1)
    log = case.vehicle_file.log
    floor = np.array([0.0, 0.0, log.get("floor_z", 0.0)])
    ceiling = log.get("ceiling_z")
    return Track(
        name=name,
        flight=flight.log,
        dt=period,
        time=grid,
        **_sensors(take, floor),
        command=_command(take) if part.has_commands else None,
        motor=motor,
        rotor_speed=take("rotor_speed"),
        voltage=None if voltage is None else smooth(voltage, 0.3, period),
        neighbours=_neighbours(case, flight, grid) - floor,
        pose_age=part.pose_age,
        attitude_derived=part.attitude_derived,
        ceiling=None if ceiling is None else ceiling - floor[2],
        fast_thrust=fast_thrust,
        missing=_missing(part.time, grid, period),
        vehicle=case.vehicle_of(flight),
    )


def own_tracks(case: Case) -> list[Track]:
    """All stretches of a case's flights with body rates and motor commands, in the air,
    at the rate of their log.
    """
    tracks = []
    for flight in case.flights:
        if not flight.has_motors or flight.body_rates is None or flight.body_rates_derived:
            continue
        holes = flight.in_holes(TORQUES, MAX_GAP, MISSED_SAMPLES)
        parts = _own_stretches(flight.rows(~holes), flight, case, SHORTEST_PART)
        if not parts:
            whole = _own_stretches(flight, flight, case, MIN_DURATION)
            parts = [replace(track, bridges_holes=bool(holes.any())) for track in whole]
        tracks += parts
    # One estimator reads rows of one period: the one that holds most of the flights.
    periods = [track.dt for track in tracks for _ in range(len(track))]
    usual = max(set(periods), key=periods.count) if periods else 0.0
    return [track for track in tracks if track.dt == usual]


def _own_stretches(rows: Flight, flight: Flight, case: Case, least: float) -> list[Track]:
    """Tracks of the stretches in the air, at least so many s long, of some `rows` of a
    flight. Lines over longer gaps than these would make motors look quicker or slower, by
    a tenth to a fifth.
    """
    tracks = []
    for stretch in rows.stretches(max(MAX_GAP, MISSED_SAMPLES * flight.row_period), least):
        track = _own_track(rows.rows(stretch), flight, case)
        runs = runs_of(flight.in_the_air(track.time, TAKE_OFF))
        tracks += [track.rows(slice(a, b)) for a, b in runs if (b - a) * track.dt >= least]
    return tracks


def _own_track(part: Flight, flight: Flight, case: Case) -> Track:
    """A stretch of a flight at the rate of its log, motors as means of what they held."""
    period = max(round(flight.row_period, 4), FASTEST_ROW)
    grid = np.arange(part.time[0], part.time[-1] - period, period)
    vehicle = case.vehicle_of(flight)
    motor = _means(*part.sampled("motor_command"), grid, period, True)
    voltage = None
    if part.battery_voltage is not None:
        voltage = smooth(part.interpolated("battery_voltage", grid), 0.3, period)
    if case.vehicle_file.motor.command == "pwm":
        motor = pwm_thrust(motor, voltage, vehicle)
    wanted_channels = (*(c for c in SENSORS if c != "position"), "rotor_speed")
    channels = [c for c in wanted_channels if getattr(part, c) is not None]
    return Track(
        name=flight.name,
        flight=flight.log,
        dt=period,
        time=grid,
        **{channel: part.interpolated(channel, grid) for channel in channels},
        motor=motor,
        voltage=voltage,
        vehicle=vehicle,
        samples=case.vehicle_file.log.get("motor_rows", "mean") == "sample",
    )


def _missing(stamps: Array, grid: Array, period: float) -> Array:
    """(T,) the rows of a grid with no logged row within half a period and a bit."""
    following_row = np.clip(np.searchsorted(stamps, grid), 1, len(stamps) - 1)
    return (
        np.minimum(np.abs(grid - stamps[following_row - 1]), np.abs(stamps[following_row] - grid))
        > 0.6 * period
    )


def held_means(
    at: Float[Array, " samples"],
    values: Float[Array, " samples"],
    begin: Float[Array, " periods"],
    period: float,
) -> Float[Array, " periods"]:
    """Means (G,) of values (S,) at times `at` (S,) s, each held until the next, over
    `period` s from `begin` (G,) s on.
    """
    return _means(at, values[:, None], begin, period, True)[:, 0]


def _means(at, values, begin, period, is_held):
    """Means (G, C) of samples (S, C) over periods, of samples that stay until the next
    (`is_held`) or of lines between them.
    """
    step = np.diff(at)[:, None] * (values[:-1] if is_held else 0.5 * (values[1:] + values[:-1]))
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(step, 0)])
    # at the end of a log a mean is of what is left of it
    begin = np.clip(begin, at[0], at[-1] - 0.5 * period)
    end = np.clip(begin + period, at[0], at[-1])
    means = [
        (np.interp(end, at, column) - np.interp(begin, at, column)) / (end - begin)
        for column in integral.T
    ]
    return np.stack(means, 1)


def _command_phase(part: Flight, period: float) -> float:
    """The time within a period (s, from the first row on) at which new commands begin: rows of the
    grid that begin there hold one each.

    A row that mixed two could not tell which of them had arrived.
    """
    if not part.has_commands:
        return 0.0
    at, values = part.sampled("command_thrust")
    new = at[1:][np.diff(values) != 0.0] - part.time[0]
    if len(new) < RHYTHM:
        return 0.0
    turns = np.exp(2j * np.pi * new / period)
    if abs(turns.mean()) < RHYTHMIC:
        return 0.0
    # late ones belong to the row that began before them: the begin is before the middle
    delays = np.angle(turns / turns.mean()) / (2 * np.pi) * period
    middle = np.angle(turns.mean()) / (2 * np.pi) * period
    return float((middle + np.percentile(delays, EARLY)) % period)


def pwm_thrust(duty: Motors, voltage: Times | None, vehicle) -> Motors:
    """Thrust fraction (T, 4) that a duty cycle gives: motor voltage U = duty x battery,
    and the public map of the Crazyflie firmware's battery compensation, U = -0.0006239
    g^2 + 0.088 g for g grams of thrust of all four rotors.
    """
    volts = duty * (3.7 if voltage is None else voltage[:, None])
    grams = (0.088 - np.sqrt(np.maximum(0.088**2 - 4 * 0.0006239 * volts, 0.0))) / (2 * 0.0006239)
    newtons = grams * 1e-3 * GRAVITY / 4
    return newtons / float(vehicle.thrust_constant * vehicle.max_rotor_speed**2)

"""The one rule that says when a flight is in the air; `Flight.airborne` keeps its answer.

Off the ground motors give at least 40 % of their usual command, and the vehicle isn't at
rest on the floor; shorter dips (half a second) are manoeuvres.
"""

import dataclasses

import numpy as np

from openjax.flights.agreement import other_frames
from openjax.flights.flight import Flight, Refused
from openjax.flights.sampling import runs_of

SHORTEST = 2.0  # s airborne: windows of 0.5 s, and a few of them
# m below the floor, where nothing flies: more than an origin on a table is off by
BELOW = 0.3
GROUND_CLEARANCE = 0.02  # m above the floor


def airborne_part(flight: Flight, floor_z: float | None, note, every: bool = False) -> Flight:
    """Cut to the longest airborne stretch, or to `every` one of a useful length; the
    flight that is returned knows its take-offs and landings.
    """
    runs = runs_of(~_on_ground(flight, floor_z))
    flight = dataclasses.replace(flight, airborne=_times(runs, flight.time))
    if not runs:
        raise Refused("short", "never took off")
    start, stop = max(runs, key=lambda r: flight.time[r[1] - 1] - flight.time[r[0]])
    airborne = flight.time[stop - 1] - flight.time[start]
    if airborne < SHORTEST:
        raise Refused(
            "short", f"airborne for {airborne:.1f} s only; at least {SHORTEST:g} s are needed"
        )
    if every:
        is_long = np.zeros(len(flight), bool)
        for first, last in runs:
            is_long[first:last] = flight.time[last - 1] - flight.time[first] >= SHORTEST
        return flight.rows(is_long)
    if stop - start < len(flight):
        seconds = flight.duration - airborne
        part = f"t = {flight.time[start]:.2f} to {flight.time[stop - 1]:.2f}"
        note("ground", f"{seconds:.1f} s on the ground are cut away (kept: {part})")
        flight = flight.rows(slice(start, stop))
    return flight


def _times(runs: list[tuple[int, int]], time: np.ndarray) -> np.ndarray:
    """(A, 2) s, begin and end of runs of rows; infinite at the log's own."""
    ends = [
        (time[a] if a > 0 else -np.inf, time[b - 1] if b < len(time) else np.inf) for a, b in runs
    ]
    return np.array(ends, float).reshape(-1, 2)


def _on_ground(flight, floor_z):
    """(T,) whether the vehicle stands, as `airborne_part` says it."""
    drive = flight.motor_command if flight.motor_command is not None else flight.command_thrust
    drive = drive if drive.ndim == 1 else drive.mean(1)
    rows = np.isfinite(drive)
    drive = np.interp(flight.time, flight.time[rows], drive[rows])
    # the median of the upper half: a long wait on the ground doesn't take it down
    usual = np.median(drive[drive >= np.median(drive)])
    if usual < 0.02:
        raise Refused(
            "short",
            f"never took off: the commands reach {np.max(drive):.2g} of their range, or are in "
            "another unit",
        )
    on_ground = _long_runs(drive < 0.4 * usual, flight.time)
    if flight.position is not None and flight.velocity is not None:
        floor = 0.0 if floor_z is None else float(floor_z)
        height = flight.interpolated("position")[:, 2] - floor
        speed = np.linalg.norm(flight.interpolated("velocity"), axis=1)
        on_ground |= (np.abs(height) < GROUND_CLEARANCE) & (speed < 0.05)
    return on_ground


def check_above_floor(flight: Flight, floor: float) -> None:
    """Nothing flies below the floor."""
    if flight.position is None:
        return
    height = float(np.nanmedian(flight.position[:, 2])) - floor
    if height < -BELOW:
        if words := other_frames(flight):
            raise Refused("axes", words)
        raise Refused(
            "axes",
            f"z is {height + floor:.2f} m in flight, below the floor at {floor:g}: z points up "
            "(scale = -1 in columns.toml), or floor_z is what z reads on the floor",
        )


def _long_runs(flags: np.ndarray, time: np.ndarray, shortest: float = 0.5) -> np.ndarray:
    """`flags` (T,) without runs of less than `shortest` s: a dip of thrust in the air
    is a manoeuvre.
    """
    long = flags.copy()
    for start, stop in runs_of(flags):
        if time[stop - 1] - time[start] < shortest:
            long[start:stop] = False
    return long

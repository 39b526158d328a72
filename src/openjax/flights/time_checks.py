"""Conditions on a log's times: in seconds, in order, without rows that occur twice, and of a
vehicle whose motors turn.
"""

import numpy as np

from openjax.flights.flight import CHANNEL_COLUMNS, Flight, Refused
from openjax.flights.sampling import SLOWEST, several_recordings

AT_REST = 0.02  # command below which a motor doesn't turn
LONG_REST = 1.0  # s


def in_time(flight: Flight, note) -> Flight:
    """Sorted by time, in seconds, without repeated rows."""
    time = flight.time
    finite = np.isfinite(time)
    if not finite.all():
        note("time", f"{(~finite).sum()} rows without a time are left out")
        flight = flight.rows(finite)
        time = flight.time
    if len(time) < 20:
        raise Refused("short", f"only {len(time)} row{'s' * (len(time) != 1)}")
    # a log that was written twice, one after the other, would look like two recordings
    flight = _sort(_written_once(flight, note), note)
    repeats = np.diff(flight.time) == 0
    if repeats.mean() > 0.2:
        raise Refused(
            "time",
            f"{repeats.mean():.0%} of the rows repeat the time of the row before: the clock is "
            "frozen, or too coarse",
        )
    if repeats.any():
        note("time", f"{repeats.sum()} rows repeat the time of the row before and are left out")
        flight = flight.rows(np.r_[True, ~repeats])
    step = flight.row_period
    _refuse_units(step)
    steps = np.diff(flight.time)
    gaps = np.flatnonzero(steps > max(5 * step, 0.05))
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        number = f"{len(gaps)} gap{'s' * (len(gaps) > 1)}"
        places = f"the longest {steps[longest]:.2f} s after t = {flight.time[longest]:.2f}"
        note("gaps", f"{number} in time, {places}")
    return flight


def while_motors_turn(flight: Flight, note) -> Flight:
    """Without the time before motors first turn and after they last do: what stands
    still there is a vehicle on the ground, not a frozen sensor.
    """
    drive = flight.motor_command if flight.motor_command is not None else flight.command_thrust
    if drive is None:
        return flight
    turning = np.flatnonzero((drive.reshape(len(drive), -1) > AT_REST).any(1))
    if not len(turning):
        return flight
    part = slice(turning[0], turning[-1] + 1)
    seconds = flight.duration - (flight.time[part.stop - 1] - flight.time[part.start])
    if seconds < LONG_REST:
        return flight
    note("ground", f"{seconds:.1f} s with motors at rest are cut away")
    return flight.rows(part)


def _sort(flight: Flight, note) -> Flight:
    """Rows out of order are sorted: a few, or any number of one recording, whose rows
    are then evenly apart. Others are several recordings.
    """
    backwards = int((np.diff(flight.time) < 0).sum())
    if not backwards:
        return flight
    in_order = _written_once(flight.rows(np.argsort(flight.time, kind="stable")), note)
    if problem := several_recordings(flight.time, in_order.time):
        raise Refused("time", problem)
    note("time", f"{backwards} rows out of order in time were sorted")
    return in_order


def _written_once(flight: Flight, note) -> Flight:
    """Without rows that repeat the one before in every column, as where a log was written twice."""
    channels = [getattr(flight, c) for c in CHANNEL_COLUMNS if getattr(flight, c) is not None]
    table = np.column_stack([flight.time, *(v.reshape(len(v), -1) for v in channels)])
    same = (table[1:] == table[:-1]) | (np.isnan(table[1:]) & np.isnan(table[:-1]))
    repeats = np.r_[False, same.all(1)]
    if not repeats.any():
        return flight
    note("time", f"{repeats.sum()} rows that occur twice were left out")
    return flight.rows(~repeats)


def _refuse_units(step: float) -> None:
    """Refuse rows that are too far apart or too close, in seconds."""
    if step > SLOWEST:
        for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
            # a unit is named if in it rows would come at 20 to 2,000 Hz
            if 5e-4 <= step / factor <= SLOWEST:
                hint = " or counts rows" if step == 1.0 else ""
                raise Refused(
                    "units",
                    f"t is in {unit}{hint} (rows {step:g} apart); the log format wants seconds",
                )
        raise Refused("time", f"rows are {step:g} s apart; at least 20 rows per second are needed")
    if step < 2e-4:
        raise Refused(
            "units", f"rows are {step:g} s apart: t is not in seconds, or the clock is corrupt"
        )

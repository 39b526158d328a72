"""Times at which a sensor was sampled: rows that hold no new sample of it, and
clocks of its own.
"""

import dataclasses

import numpy as np

from openjax.flights.flight import CHANNEL_COLUMNS, SENSORS, Flight, Refused
from openjax.flights.shapes import Chosen

FROZEN = 0.5  # s without a change of a sensor that has noise
# share of rows that repeat the one before, from which a sensor is slower than the rows
HELD = 0.1
SLOWEST = 0.05  # s between rows of a flight
IN_STEP = 50  # poses from which a clock of their own is looked for
IN_PHASE = 0.25  # concentration of their phases (0 to 1) from which they have one
EDGE = 0.03  # cycles of that clock by which its phase may be wrong


def several_recordings(time: np.ndarray, in_order: np.ndarray | None = None) -> str:
    """The fault in the order of times (T,), in s: nothing if few rows are out of it, or if all are
    those of one recording, shuffled. `in_order`: the same sorted, less rows that occur twice.
    """
    steps = np.diff(time)
    backwards = int((steps < 0).sum())
    # a few rows that come late, as packets do that others overtook, are put in order
    few = not backwards or (steps.min() >= -1.0 and backwards <= 0.05 * len(time))
    if few or _even(np.sort(time) if in_order is None else in_order):
        return ""
    at = time[int(np.argmin(steps))]
    return (
        f"time runs backwards (after t = {at:g}): several recordings in one file, or unsorted; one "
        "flight, one file, by time"
    )


def _even(time: np.ndarray) -> bool:
    """True if times (T,), sorted, are those of one recording: two that were put together leave
    steps of all lengths, or a gap between them.
    """
    steps = np.diff(time)
    middle = float(np.median(steps))
    return bool((steps > 0.5 * middle).mean() > 0.95 and steps.max() < max(5.0 * middle, 0.5))


def drop_frozen(flight: Flight, note) -> Flight:
    """Constant columns refuse or drop their channel; frozen stretches become not
    sampled; holes are named.
    """
    changes = {}
    holes: dict[str, list[str]] = {}
    for channel in (c for c in CHANNEL_COLUMNS if getattr(flight, c) is not None):
        values = getattr(flight, channel)
        names = ", ".join(CHANNEL_COLUMNS[channel])
        rows = np.flatnonzero(np.isfinite(values.reshape(len(values), -1)).all(1))
        if len(rows) < 2:
            raise Refused("corrupt", f"{names}: hardly any row holds a number")
        if channel in SENSORS or channel == "motor_command":
            frozen = _standing_still(flight, channel, rows, note)
            if frozen.any():
                changes[channel] = _unsample(values, frozen)
                rows = rows[~frozen[rows]]
        if channel != "battery_voltage" and len(rows) > 1 and (hole := _hole(flight.time, rows)):
            holes.setdefault(hole, []).append(names)
    for hole, names in holes.items():
        note("gaps", f"{', '.join(names)}: {hole}")
    return dataclasses.replace(flight, **changes) if changes else flight


def _standing_still(flight: Flight, channel: str, rows, note) -> np.ndarray:
    """(T,) rows in which a sensor is frozen; of columns that never change nothing can be used."""
    columns = CHANNEL_COLUMNS[channel]
    values = getattr(flight, channel)
    table = values.reshape(len(values), -1)
    is_new = np.diff(table[rows], axis=0) != 0
    as_one = channel in ("position", "quaternion", "velocity")
    dead = np.flatnonzero(~is_new.any(0)).tolist()
    if as_one and is_new.any():
        dead = [k for k in dead if not _may_stand_still(flight, channel, k)]
    if len(dead):
        names = ", ".join(columns[i] for i in dead)
        raise Refused(
            "corrupt", f"{names}: the same value {table[rows[0], dead[0]]:g} in every row"
        )
    frozen = _frozen(table, rows, flight.time, as_one)
    if frozen.any():
        share = frozen.mean()
        start = flight.time[np.argmax(frozen)]
        sentence = f"stand still for {share * flight.duration:.1f} s from t = {start:.2f}"
        words = f"{', '.join(columns)} {sentence}"
        if share > 0.5:
            raise Refused("corrupt", f"{words}: frozen for {share:.0%} of the flight")
        note("corrupt", f"{words}; taken as not sampled there")
    return frozen


def _may_stand_still(flight: Flight, channel: str, column: int) -> bool:
    """True if one column may hold one value while the others of its channel change, as where a
    simulated vehicle stays in a plane: what follows from it then stands still, too.
    """
    other = {"position": "velocity", "velocity": "position"}.get(channel)
    if other is None:
        return True
    values = getattr(flight, other)
    return values is not None and not np.ptp(flight.sampled(other)[1], axis=0)[column]


def _hole(time: np.ndarray, rows: np.ndarray) -> str:
    """The longest stretch without samples, in words, if rows go on meanwhile. Otherwise it is a gap
    in time, which is named already.
    """
    steps = np.diff(time[rows])
    hole = int(np.argmax(steps))
    if rows[hole + 1] - rows[hole] <= 1 or steps[hole] <= max(0.2, 10 * np.median(steps)):
        return ""
    return f"not sampled for {steps[hole]:.2f} s after t = {time[rows][hole]:.2f}"


def drop_held_rows(flight: Flight, note) -> Flight:
    """Without the rows of a logger that was faster than all it logged, motors and
    commands as well: they repeat the one before in every column but the time's and the
    battery's. Longer stretches without a change are a stand, or frozen.
    """
    channels = [
        c for c in CHANNEL_COLUMNS if c != "battery_voltage" and getattr(flight, c) is not None
    ]
    table = np.column_stack([getattr(flight, c).reshape(len(flight), -1) for c in channels])
    same = (table[1:] == table[:-1]) | (np.isnan(table[1:]) & np.isnan(table[:-1]))
    is_held = np.r_[False, same.all(1)]
    for begin, end in runs_of(is_held):
        if flight.time[end - 1] - flight.time[begin - 1] > 0.5 * FROZEN:
            is_held[begin:end] = False
    if is_held.mean() < HELD or np.median(np.diff(flight.time[~is_held])) > SLOWEST:
        return flight
    note(
        "held", f"{is_held.mean():.0%} of the rows repeat the one before in every column: left out"
    )
    return flight.rows(~is_held)


def drop_repeats(flight: Flight, note) -> Flight:
    """A sensor that is slower than the rows and whose last sample was written again counts as
    sampled where it changed. A sample that appears in a row may be older than it by up to a row.
    """
    changes = {}
    for group in (("position", "quaternion", "velocity"), ("body_rates", "specific_force")):
        channels = [c for c in group if getattr(flight, c) is not None]
        if not channels:
            continue
        stack = np.concatenate([getattr(flight, c).reshape(len(flight), -1) for c in channels], 1)
        repeats = np.r_[False, (np.diff(stack, axis=0) == 0).all(1)]
        if repeats.mean() < HELD:
            continue
        note(
            "held",
            f"{repeats.mean():.0%} of the rows repeat the last sample of {', '.join(channels)}: "
            "left out",
        )
        for channel in channels:
            changes[channel] = _unsample(getattr(flight, channel), repeats)
        if group[0] == "position":
            changes["pose_age"] = flight.row_period
    return dataclasses.replace(flight, **changes) if changes else flight


def put_in_step(flight: Flight, note) -> Flight:
    """Poses at the times of their rows, where the camera is slower than the log: a row says only
    that a new pose came since the last one, and the camera's own clock is regular. Poses are on a
    line through their rows; a held one is half a row late on the mean.
    """
    channels = [c for c in ("position", "quaternion", "velocity") if getattr(flight, c) is not None]
    if not channels:
        return flight
    rows = np.flatnonzero(
        np.all(
            [np.isfinite(getattr(flight, c).reshape(len(flight), -1)).all(1) for c in channels], 0
        )
    )
    if len(rows) < IN_STEP or len(rows) > (1.0 - HELD) * len(flight):
        return flight
    stamps = flight.time[rows]
    regular = _regular_clock(stamps, flight.row_period)
    if regular is None:
        return flight
    # a pose seen first in a row is older than that by half a row on the mean
    regular = regular - 0.5 * flight.pose_age
    # its time is known now
    changes = {"pose_age": 0.0}
    for channel in channels:
        values = getattr(flight, channel)
        result = np.full_like(values, np.nan)
        result[rows] = _on_lines(stamps, regular, values[rows])
        changes[channel] = result
    rate = (len(regular) - 1) / (regular[-1] - regular[0])
    note(
        "held",
        f"poses come at {rate:.0f} Hz on a clock of their own: they are moved to the rows' times",
    )
    # where the body is after the last pose, or before the first, isn't known
    return dataclasses.replace(flight, **changes).rows(slice(rows[0], rows[-1] + 1))


def _on_lines(stamps: np.ndarray, regular: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (S, ...) of times `regular` (S,) at the times `stamps` (S,), on lines
    through their neighbours: the last one's goes on to the end, as a pose that is held
    there would stand still for a row.
    """
    tick = np.clip(np.searchsorted(regular, stamps, "right") - 1, 0, len(regular) - 2)
    share = (stamps - regular[tick]) / (regular[tick + 1] - regular[tick])
    return values[tick] + share[:, None] * (values[tick + 1] - values[tick])


def _regular_clock(times: np.ndarray, row: float) -> np.ndarray | None:
    """Times (S,) of a regular clock whose ticks were seen at times (S,) up to a `row` s
    apart from it, later where rows are missing; None where they have none. Its rate is
    where the phases of what was seen agree most (Rayleigh's periodogram).
    """
    since = times - times[0]
    usual = (len(times) - 1) / since[-1]
    # ticks that no row shows make the mean rate too low, so more is looked at above it;
    # a fifth of the periodogram's resolution misses no peak
    rates = np.arange(0.9 * usual, 1.15 * usual, 0.2 / since[-1])
    phasor = np.exp(2j * np.pi * rates[:, None] * since).mean(1)
    best = int(np.argmax(np.abs(phasor)))
    if np.abs(phasor[best]) < IN_PHASE:
        return None
    middle = np.angle(phasor[best]) / (2.0 * np.pi)
    # cycles since a tick could first be seen
    phase = rates[best] * since - middle + 0.5 * row * rates[best]
    ticks = np.floor(phase + EDGE)
    usual = phase - ticks < row * rates[best] + EDGE
    # No two poses have one tick: where rows are missing, what came before the next pose
    # is a tick older.
    order = np.arange(len(ticks))
    ticks = np.minimum.accumulate((ticks - order)[::-1])[::-1] + order
    slope, start = np.polyfit(ticks[usual], times[usual], 1)
    return start + slope * ticks


def _unsample(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Values (T, ...) without those of some rows (T,)."""
    result = values.copy()
    result[rows] = np.nan
    return result


def _frozen(table: np.ndarray, rows: np.ndarray, time: np.ndarray, as_one: bool) -> np.ndarray:
    """(T,) True in runs of at least FROZEN seconds in which a column (all columns if
    `as_one`) doesn't change though it does elsewhere. Runs at the column's extremes
    are saturation, not a frozen sensor.
    """
    values = table[rows]
    is_still = np.diff(values, axis=0) == 0
    extreme = (values == values.min(0)) | (values == values.max(0))
    if as_one:
        per_column = [is_still.all(1)]
    else:
        per_column = [s & ~e for s, e in zip(is_still.T, extreme[1:].T, strict=True)]
    frozen = np.zeros(len(time), bool)
    for run in per_column:
        for start, stop in runs_of(run):
            if time[rows[stop]] - time[rows[start]] >= FROZEN:
                frozen[rows[start] + 1 : rows[stop] + 1] = True
    return frozen


def runs_of(flags: Chosen) -> list[tuple[int, int]]:
    """First row and the one after the last of every stretch in which `flags` (T,) hold."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags, 0]))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))

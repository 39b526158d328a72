"""Streams of one log put on one clock.

Loggers sample position, gyroscope, commands and battery at rates and moments of their own.
The columns of the log format are one table: its rows are those of the fastest stream with
motion in it, onto which the others are moved.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

from openjax.flights.importers.columns import EULER, Source, with_quaternion
from openjax.flights.reading import CHANNEL_COLUMNS, LogError
from openjax.flights.sampling import several_recordings

MOTION = {
    *CHANNEL_COLUMNS["position"],
    *CHANNEL_COLUMNS["quaternion"],
    *CHANNEL_COLUMNS["body_rates"],
    *CHANNEL_COLUMNS["specific_force"],
}
"""Columns one of which the stream must hold whose clock counts."""
CONTINUOUS = MOTION.union(CHANNEL_COLUMNS["velocity"], CHANNEL_COLUMNS["rotor_speed"], EULER)
"""Columns between whose samples a line is drawn."""
OVERTAKEN = 1.0
"""A message may come this long (s) before an older one."""
TIE = 1e-6
"""What comes so much later (s) than a row was sent with it: stamps since 1970 are known to
0.24 us.
"""
STALE = 5.0
"""After so many periods of its stream a last value counts as not sampled."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Raw signals sampled together: time (N,) s and values {raw name: (N,)}."""

    time: np.ndarray
    values: dict[str, np.ndarray]


def merge_streams(
    streams: list[Stream], columns: dict[str, Source]
) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Columns of the log format on one clock: that of the fastest stream with motion in it (`t` as
    in the stream).

    Other motion streams are interpolated linearly, commands are held, the battery keeps its own
    samples. What is older than five periods of its stream counts as not sampled. Raises LogError if
    no motion is there, if a stream holds several recordings, or if it ends before the others begin.
    """
    series = []
    for stream in streams:
        sources = {c: s for c, s in columns.items() if s.name in stream.values}
        if sources and np.isfinite(stream.time).sum() > 1:
            series.append(_convert(stream, sources))
    with_motion = [u for u in series if MOTION & set(u[1])]
    if not with_motion:
        raise LogError(
            "holds neither position and orientation nor a gyroscope under known names: name what "
            "it has in columns.toml"
        )
    # to a microsecond: of streams at one rate the first is the clock, however stamps are rounded
    clock = min(with_motion, key=lambda u: round(float(np.median(np.diff(u[0]))), 6))[0]
    # a message that came twice is one row
    clock = clock[np.r_[True, np.diff(clock) > 0]]
    series = _at_one_time(series, clock)
    table = {"t": clock}
    for time, columns_of_stream in series:
        # of stamps that all are the same the median is nought
        period = max(float(np.median(np.diff(time))), 1e-4)
        for column, values in columns_of_stream.items():
            table.setdefault(column, _onto(clock, time, values, column, period))
    return with_quaternion(table)


def _convert(
    stream: Stream, sources: dict[str, Source]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times of a stream, sorted, and its columns in the log format's units. Raises
    LogError for several recordings.
    """
    finite = np.isfinite(stream.time)
    time = stream.time[finite]
    back = float(np.diff(time).min())
    if back < -OVERTAKEN and (problem := several_recordings(time)):
        raise LogError(problem)
    order = np.argsort(time, kind="stable")
    columns = {}
    for column, source in sources.items():
        values = source.scale * stream.values[source.name] + source.offset
        columns[column] = values[finite][order]
    return time[order], columns | _without_flips(columns)


def _at_one_time(streams, clock: np.ndarray) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """The streams that were logged while the clock ran. Raises LogError for one that
    wasn't, where no other one has its columns; the battery may be missing.
    """
    beside = [u for u in streams if u[0][0] <= clock[-1] and u[0][-1] >= clock[0]]
    elsewhere = {column for _, columns_of_stream in beside for column in columns_of_stream}
    for time, columns_of_stream in streams:
        absent = [column for column in columns_of_stream if column not in elsewhere | {"vbat"}]
        if absent:
            raise LogError(
                f"{', '.join(absent)} were logged from {time[0]:.2f} to {time[-1]:.2f} s, and "
                f"the rest from {clock[0]:.2f} to {clock[-1]:.2f} s: of another flight, or by "
                "another clock?"
            )
    return beside


def _without_flips(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The quaternion of a stream without jumps between q and -q, which no line between
    two samples may cross; nothing where it has none.
    """
    names = CHANNEL_COLUMNS["quaternion"]
    if not all(name in columns for name in names):
        return {}
    quaternion = np.stack([columns[name] for name in names], 1)
    flips = (quaternion[1:] * quaternion[:-1]).sum(1) < 0.0
    sign = np.where(np.cumsum(np.r_[False, flips]) % 2, -1.0, 1.0)
    return dict(zip(names, (quaternion * sign[:, None]).T, strict=True))


def _onto(clock, time, values, column: str, period: float) -> np.ndarray:
    """Values (N,) of a column at its `time` (N,) moved to the rows of `clock` (T,)."""
    if len(time) == len(clock) and np.array_equal(time, clock):
        return values
    finite = np.isfinite(values)
    time = time[finite]
    values = values[finite]
    if not len(time):
        return np.full(len(clock), np.nan)
    # what was sent with a row is there with it, however its stamp was rounded
    previous = np.searchsorted(time, clock + TIE, side="right") - 1
    if column == "vbat":
        out = np.full(len(clock), np.nan)
        nearest = np.clip(np.searchsorted(clock, time), 0, len(clock) - 1)
        out[nearest] = values
        return out
    if column in CONTINUOUS:
        out = np.interp(clock, time, values, left=np.nan, right=np.nan)
        following_row = np.clip(previous + 1, 0, len(time) - 1)
        # a line over a hole would look like a motion
        is_wide = time[following_row] - time[np.clip(previous, 0, None)] > max(STALE * period, 0.05)
        return np.where(is_wide, np.nan, out)
    # a command holds until the next one comes
    last = np.clip(previous, 0, None)
    out = np.where(previous >= 0, values[last], np.nan)
    return np.where(clock - time[last] > max(STALE * period, 0.1), np.nan, out)

"""CSV files with a time stamp for each topic, as exports from bags have them: `pose.time, pose.x,
..., imu.time, imu.wx, ...`. What stands in a row together needn't have been measured together, so
that each topic is a stream with its own clock, merged as a bag's topics are.

The layout is evident where two or more columns are called like a topic and a time. Without a
`columns.toml` the last part of a name says what it holds: `imu.wx` is `wx`, `quat.w` is `qw`.
"""

import re
from pathlib import Path

import numpy as np

from openjax.errors import suggestion
from openjax.flights.importers.columns import EULER, ColumnMapping, Source, with_units
from openjax.flights.importers.csv_files import (
    delimiter_of,
    header_of,
    is_log_format,
    raw_columns,
    seconds_per_unit,
)
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import LOG_COLUMNS, LONGEST_NAME, LogError, LogTable

SEPARATORS = "./:"
MOST_NAMES = 100  # of a header among which a name that isn't there is looked for
_STAMP = re.compile(rf"(.+?)(?:[{SEPARATORS}]header)?[{SEPARATORS}_](time|timestamp|stamp|t)", re.I)
# What the last part of a name holds by the topic that it stands in: "vel.x" is vx.
GROUPS = {
    "pos": {a: a for a in "xyz"},
    "position": {a: a for a in "xyz"},
    "quat": {a: f"q{a}" for a in "wxyz"},
    "quaternion": {a: f"q{a}" for a in "wxyz"},
    "orientation": {a: f"q{a}" for a in "wxyz"},
    "vel": {a: f"v{a}" for a in "xyz"},
    "velocity": {a: f"v{a}" for a in "xyz"},
    "gyro": {a: f"w{a}" for a in "xyz"},
    "angular_velocity": {a: f"w{a}" for a in "xyz"},
    "acc": {a: f"a{a}" for a in "xyz"},
    "accel": {a: f"a{a}" for a in "xyz"},
    "linear_acceleration": {a: f"a{a}" for a in "xyz"},
}


def stamps_of(names: list[str]) -> dict[str, str]:
    """{topic: the column of its time stamp} of a header's names."""
    matches = {name: _STAMP.fullmatch(name) for name in names}
    return {match[1]: name for name, match in matches.items() if match}


def topic_of(name: str, topics) -> str | None:
    """The topic of a column: the longest that its name begins with."""
    mine = [t for t in topics if name == t or re.match(rf"{re.escape(t)}[{SEPARATORS}_]", name)]
    # a column of imu_2 begins like imu as well
    return max(mine, key=len, default=None)


def has_topic_times(path: Path) -> bool:
    """True if a CSV has several time stamps, and none for all."""
    names = header_of(path)
    return len(stamps_of(names)) > 1 and not is_log_format(names)


def read_topic_times(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """A CSV of topics. Raises LogError where it holds no column that is known."""
    delimiter = delimiter_of(mapping)
    names = header_of(path, delimiter)
    mapping = None if mapping is None else with_units(mapping, names)
    stamps = _named_stamps(names, mapping)
    repeats = []
    if mapping is None:
        sources, repeats = recognise(names, stamps)
    else:
        sources = _map(names, mapping)
    clock_of = _clocks(sources, stamps, mapping)
    columns_read = (*stamps.values(), *(source.name for source in sources.values()))
    raw, remarks = raw_columns(path, columns_read, next(iter(stamps.values())), delimiter)
    streams, begin = _streams(raw, sources, clock_of, mapping)
    if repeats:
        remarks.append(
            f"columns that repeat others are left out, {repeats[0]} to {repeats[-1]}: log each "
            "vehicle into a file of its own"
        )
    absent = [source.name for source in sources.values() if source.name not in raw]
    remarks += [f"no column {name!r}" for name in absent]
    clocks = sorted(set(clock_of.values()))
    if mapping is not None and not mapping.clocks and len(clocks) > 1:
        remarks.append(f"each topic's columns are at its own times: {', '.join(clocks)}")
    table = merge_streams(streams, sources)
    start = begin + float(table["t"][0])
    table["t"] = table["t"] - table["t"][0]
    vehicle = np.full(len(table["t"]), "0")
    return LogTable(path.name, table, vehicle, tuple(remarks), clock_start=start)


def _map(names: list[str], mapping: ColumnMapping) -> dict[str, Source]:
    """{column: source} of what a `columns.toml` names, and of columns that have names
    of the log format already. Raises LogError for nothing.
    """
    usual = {name: Source(name) for name in names if name in LOG_COLUMNS[2:]}
    sources = mapping.over(usual)
    if not {source.name for source in sources.values()} & set(names):
        raise LogError("columns.toml names times of the log, but none of its other columns")
    return sources


def recognise(names: list[str], stamps: dict[str, str]) -> tuple[dict[str, Source], list[str]]:
    """{column: source} of what a header's names say by themselves, and the names of
    columns that are there already. Raises LogError for nothing.
    """
    sources = {}
    repeats = []
    for name in names:
        topic = topic_of(name, stamps)
        if topic is None or name in stamps.values():
            continue
        short = name[len(topic) + 1 :]  # "wx" of "imu_wx"
        *groups, last = re.split(rf"[{SEPARATORS}]", name)
        last = short if short in LOG_COLUMNS[2:] else last
        column = next((GROUPS[g][last] for g in groups[::-1] if last in GROUPS.get(g, ())), last)
        if column in LOG_COLUMNS[2:] or column in EULER:
            if column in sources:
                repeats.append(name)
            sources.setdefault(column, Source(name))
    if not sources:
        raise LogError(
            f"each topic has a time stamp ({', '.join(stamps.values())}), but no column is called "
            f"like x, qw, wx, m1: say in columns.toml which is which"
        )
    return sources, repeats


def _named_stamps(names: list[str], mapping: ColumnMapping | None) -> dict[str, str]:
    """{topic: column} of the time stamps that the header shows and those that
    `columns.toml` names. Raises LogError for one that isn't there.
    """
    stamps = stamps_of(names)
    for clock in () if mapping is None else mapping.clocks:
        name = clock.source.name
        if name not in names:
            # a broken log may have thousands of columns, or one of a thousand letters
            columns = [n[:LONGEST_NAME] for n in names[:MOST_NAMES]]
            raise LogError(f"no column {name!r} for t; {suggestion(name, columns)}")
        if name not in stamps.values():
            stamps[name] = name
    return stamps


def _clocks(sources, stamps: dict[str, str], mapping: ColumnMapping | None) -> dict[str, str]:
    """{column: the time stamp's column} of what is read: what `columns.toml` says, its topic's, or
    else the first that it names. Raises LogError for a column that has none.
    """
    named_sources = {}
    usual = None
    if mapping is not None:
        named_sources = {column: c.source.name for c in mapping.clocks for column in c.columns}
        usual = mapping.columns["t"].name if "t" in mapping.columns else None
    clock_of = {}
    for column, source in sources.items():
        topic = topic_of(source.name, stamps)
        clock_of[column] = named_sources.get(column, usual if topic is None else stamps[topic])
        if clock_of[column] is None:
            raise LogError(f"column {source.name!r} has no time stamp: name it for t")
    return clock_of


def _streams(raw, sources, clock_of: dict[str, str], mapping) -> tuple[list[Stream], float]:
    """A stream for each time stamp in use, in seconds since the first of any, and when
    that was; rows that repeat a stamp hold nothing new.
    """
    clocks = [clock for clock in dict.fromkeys(clock_of.values()) if clock in raw]
    units = {} if mapping is None else {c.source.name: c.source.scale for c in mapping.clocks}
    usual = None if mapping is None or "t" not in mapping.columns else mapping.columns["t"].scale
    scale = {c: units.get(c, usual or seconds_per_unit(raw[c])) for c in clocks}
    # Stamps since 1970 in ns are known to 256 ns as floats; their differences lose no more.
    begin = {
        unit: min(np.nanmin(raw[c]) for c in clocks if scale[c] == unit) for unit in scale.values()
    }
    start = min(unit * first for unit, first in begin.items())
    streams = []
    for clock in clocks:
        unit = scale[clock]
        time = (raw[clock] - begin[unit]) * unit + (begin[unit] * unit - start)
        _, rows = np.unique(time, return_index=True)
        rows = rows[np.isfinite(time[rows])]
        finite = int(np.isfinite(time).sum())
        if 1 <= len(rows) < min(4, finite):
            raise LogError(
                f"{clock} hardly moves ({len(rows)} different of {finite} stamps): a clock that "
                "stopped, or digits that a spreadsheet cut"
            )
        mine = {sources[c].name for c, k in clock_of.items() if k == clock} & set(raw)
        streams.append(Stream(time[rows], {name: raw[name][rows] for name in mine}))
    return streams, start


IMPORTER = Importer("CSV with a time stamp for each topic", has_topic_times, read_topic_times)

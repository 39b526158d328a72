"""Bitcraze micro-SD deck logs (the binary files that a Crazyflie writes while flying).

Layout, little endian (crazyflie-firmware, tools/usdlog): byte 0xBC; uint16 version (1
or 2); uint16 number of event types; for each: uint16 id, name and NUL, uint16 number of
variables, each "group.name(T)" and NUL with T a struct letter. Then records: uint16
event id, time stamp (version 1: uint32 ms, version 2: uint64 us), the variables packed.
The last four bytes are the CRC-32 of all before.

Before 2020 the firmware wrote one line of text, "#tick(I),group.name(T),...", and then
rows of these variables, packed, little endian, without a checksum. Ticks are in ms or
us, whatever the build counted.
"""

import re
import struct
from pathlib import Path
from zlib import crc32

import numpy as np

from openjax.flights.csv_text import LARGEST, LogError
from openjax.flights.importers.columns import ColumnMapping
from openjax.flights.importers.csv_files import seconds_per_unit
from openjax.flights.importers.firmware import are_duty_cycles, firmware_columns, with_mixer
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import LogTable

MAGIC = 0xBC
# by version, how a record begins (its kind and its ticks), and seconds in a tick
_VERSIONS = {1: ("<HI", 1e-3), 2: ("<HQ", 1e-6)}
_TYPES = set("bBhHiIqQefd")
_VARIABLE = r"\w+(?:\.\w+)?\([bBhHiIqQefd]\)"
_TEXT_HEADER = re.compile(
    rf"#?\s*(tick|timestamp|time)\(([IQ])\)((?:,\s*{_VARIABLE})+),?\s*".encode()
)
LONGEST_HEADER = 4096  # bytes: some hundred variables


def is_micro_sd(path: Path) -> bool:
    """True if a file starts like a micro-SD log."""
    if not path.is_file() or path.suffix in (".csv", ".gz", ".toml", ".md", ".txt"):
        return False
    with path.open("rb") as file:
        head = file.read(LONGEST_HEADER)
    if _TEXT_HEADER.fullmatch(head.partition(b"\n")[0]):
        return True
    return len(head) >= 5 and head[0] == MAGIC and int.from_bytes(head[1:3], "little") in _VERSIONS


def read_micro_sd(path: str | Path, mapping: ColumnMapping | None = None) -> LogTable:
    """Read a micro-SD log. The firmware's usual log variables are looked for, unless
    the mapping names others.

    Raises LogError if it isn't such a log, or holds nothing that can be used.
    """
    path = Path(path)
    if path.stat().st_size > LARGEST:
        raise LogError(f"holds more than {LARGEST >> 20} MB: no log of a flight")
    streams, remarks = decode(path.read_bytes())
    streams = [with_mixer(stream) for stream in streams]
    columns, more_remarks = firmware_columns(streams, mapping)
    remarks += more_remarks
    table = merge_streams(streams, columns)
    table["t"] = table["t"] - table["t"][0]
    vehicle = np.full(len(table["t"]), "0")
    return LogTable(path.name, table, vehicle, tuple(remarks), are_duty_cycles(columns))


def decode(data: bytes) -> tuple[list[Stream], list[str]]:
    """The events of a micro-SD log as streams, one per event type, and remarks. Raises
    LogError if it is none.
    """
    header, _, rows = data.partition(b"\n")
    if match := _TEXT_HEADER.fullmatch(header):
        return _packed_rows(match, rows)
    if len(data) < 9 or data[0] != MAGIC:
        raise LogError("not a micro-SD log (it doesn't start with 0xBC)")
    version, event_types = struct.unpack_from("<HH", data, 1)
    if version not in _VERSIONS:
        raise LogError(f"micro-SD log of version {version}; versions 1 and 2 are known")
    remarks = []
    end = len(data) - 4
    if crc32(data[:end]) != int.from_bytes(data[end:], "little"):
        # Power was cut before the file was closed: what was written is there, its checksum isn't.
        remarks.append(
            "the checksum doesn't match: the log is cut off or corrupt, read as far as it goes"
        )
        end = len(data)
    try:
        events, start = _header(data, event_types)
    except (struct.error, IndexError, ValueError) as error:
        raise LogError("micro-SD log with a corrupt header") from error
    head, tick = _VERSIONS[version]
    streams = []
    for event, records in _records(data, start, end, events, head).items():
        dtype = events[event]
        if records and dtype.names:
            stamps, payloads = zip(*records, strict=True)
            rows = np.frombuffer(b"".join(payloads), dtype)
            time = np.array(stamps, np.float64) * tick
            streams.append(Stream(time, {name: rows[name].astype(float) for name in dtype.names}))
    if not streams:
        raise LogError("micro-SD log without a record")
    return streams, remarks


def _packed_rows(header: re.Match, data: bytes) -> tuple[list[Stream], list[str]]:
    """The only stream of a log with a line of text above its rows, and remarks."""
    name, letter, rest = (group.decode() for group in header.groups())
    variables = re.findall(r"([\w.]+)\((\w)\)", rest)
    try:
        dtype = np.dtype([(n, "<" + np.dtype(t).str[1:]) for n, t in [(name, letter), *variables]])
    except ValueError as error:  # a name that occurs twice
        raise LogError(f"micro-SD log with a corrupt header: {error}") from error
    count, rest_bytes = divmod(len(data), dtype.itemsize)
    if not count:
        raise LogError("micro-SD log without a record")
    rows = np.frombuffer(data, dtype, count)
    # unsigned differences count on where a tick of 32 bits began again at zero
    steps = np.diff(rows[name])
    ticks = np.concatenate(
        [[0.0], np.cumsum(steps.astype(np.int32 if letter == "I" else np.int64))]
    )
    stream = Stream(
        ticks * seconds_per_unit(ticks), {n: rows[n].astype(float) for n, _ in variables}
    )
    return [stream], ["the last row is cut off and left out"] if rest_bytes else []


def _records(
    data: bytes, at: int, end: int, events, head: str
) -> dict[int, list[tuple[int, bytes]]]:
    """Event id -> (stamp, packed record) of every one from byte `at` on; the last of a
    log that was cut off may be torn.
    """
    records: dict[int, list[tuple[int, bytes]]] = {event: [] for event in events}
    head_size = struct.calcsize(head)
    while at + head_size <= end:
        event, stamp = struct.unpack_from(head, data, at)
        if event not in events:
            if end != len(data):
                raise LogError(f"micro-SD log with an unknown event {event} at byte {at}: corrupt")
            break
        size = events[event].itemsize
        at += head_size
        if at + size > end:
            break
        records[event].append((stamp, data[at : at + size]))
        at += size
    return records


def _header(data: bytes, event_types: int) -> tuple[dict[int, np.dtype], int]:
    """Event id -> packed record type, and where the records start."""

    def text(at: int) -> tuple[str, int]:
        stop = data.index(0, at)
        return data[at:stop].decode("utf-8"), stop + 1

    events = {}
    at = 5
    for _ in range(event_types):
        (event,) = struct.unpack_from("<H", data, at)
        _, at = text(at + 2)
        (count,) = struct.unpack_from("<H", data, at)
        at += 2
        fields = []
        for _ in range(count):
            variable, at = text(at)
            name = variable[:-3]
            letter = variable[-2]
            if letter not in _TYPES:
                raise ValueError(variable)
            fields.append((name, "<" + np.dtype(letter).str[1:]))
        events[event] = np.dtype(fields)
    return events, at


IMPORTER = Importer("micro-SD log of a Crazyflie", is_micro_sd, read_micro_sd)

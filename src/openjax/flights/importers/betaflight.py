"""Betaflight's blackbox, binary through the `orangebox` library, and CSV files as
`blackbox_decode` and the Blackbox Explorer write them. Indiflight, a fork, adds pose and
rotor speeds to it (tudelft/indiflight, blackbox.c).

`blackbox_decode` (blackbox-tools, blackbox_decode.c) puts a field's unit in brackets
behind its name unless the field is raw. Raw are degrees per second for `gyroADC` and
`setpoint`, counts of the sensor for `accSmooth`, thousandths for the throttle, and for
`motor` either pulses of 1000 to 2000 us or DShot's 48 to 2047. The Explorer writes raw
values only, and above the columns a line for each of the log's headers, which say their
scale (blackbox-log-viewer, csv-export-worker.js and flightlog_fields_presenter.js).
`blackbox_decode --save-headers` puts the same lines into a file of their own.

Axes are forward, left, up, as here: the mixer's signs say so, in which a positive pitch
raises the rear motors. Motors are rear right, front right, rear left, front left.
"""

import contextlib
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.csv_text import LARGEST, find_header, head_of
from openjax.flights.importers.columns import UNITS, ColumnMapping, Source
from openjax.flights.importers.csv_files import delimiter_of, is_csv, raw_columns
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import CHANNEL_COLUMNS, LogError, LogTable

MAGIC = b"H Product:Blackbox"
DSHOT = (48.0, 2047.0)  # the least and the largest throttle value of the protocol
PULSE = (1000.0, 2000.0)  # us
# {nominal place's column: index of Betaflight's motor}, mixerQuadX in flight/mixer_init.c
MOTOR_OF = {"m1": 1, "m2": 0, "m3": 2, "m4": 3}
FIRST = "loopIteration"  # the name of the first column
HEADERS_FILE = ".headers.csv"
# how else files are called that a decoder writes
BESIDE = (HEADERS_FILE, ".gps.csv", ".event.csv")
QUATERNION_UNIT = 8127.0  # counts of Indiflight for 1: 127 * 64 - 1
_POSE = (*CHANNEL_COLUMNS["position"], *CHANNEL_COLUMNS["velocity"], *CHANNEL_COLUMNS["quaternion"])
FINE = 10.0  # by which blackbox_high_resolution multiplies rates
_UNIT_NAMES = {"m/s2": "m/s^2"}
_FIELD = re.compile(r"(.*?)(?: \((.*)\))?")


def is_blackbox_csv(path: Path) -> bool:
    """True if a CSV is a decoded blackbox."""
    if not is_csv(path):
        return False
    lines = head_of(path)
    above = _lines_above(lines)
    return above is not None and "time" in lines[above]


def is_beside(path: Path) -> bool:
    """True if a file is no log of its own, but what a decoder wrote beside one."""
    ending = next((end for end in BESIDE if path.name.endswith(end)), None)
    return ending is not None and path.with_name(path.name.removesuffix(ending) + ".csv").exists()


def _lines_above(lines: list[str]) -> int | None:
    """The number of lines above the columns' names; None if there are no such names."""
    first = (line.lstrip(' "').startswith(FIRST) for line in lines)
    return next((number for number, is_first in enumerate(first) if is_first), None)


def _headers(lines: list[str]) -> dict[str, str]:
    """{name: value} of the log's headers, one a line."""
    pairs = (line.partition(",") for line in lines)
    return {name.strip(' "'): value.strip(' "') for name, _, value in pairs}


def is_blackbox_binary(path: Path) -> bool:
    """True if a file is a blackbox that is still to be decoded."""
    if not path.is_file():
        return False
    if path.suffix.lower() in (".bbl", ".bfl"):
        return True
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def read_blackbox_binary(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """A blackbox as the flight controller wrote it. Raises LogError where it can't be
    read, UserError without the library.
    """
    try:
        from orangebox import Parser
    except ImportError as error:
        raise UserError(
            f"{path}: reading a blackbox needs the orangebox library: pip install 'orangebox<0.5' "
            "(or decode it with blackbox_decode, and put the .csv here)"
        ) from error
    if path.stat().st_size > LARGEST:
        raise LogError(f"holds more than {LARGEST >> 20} MB: cut it into flights")
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # it tells of damages there
            parser = Parser.load(str(path))
            names = parser.field_names
            rows = [frame.data for frame in parser.frames() if frame.type.value in ("I", "P")]
            logs = parser.reader.log_count
    except Exception as error:  # damaged logs raise many kinds; all mean the same here
        words = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f"blackbox can't be read: {words}") from error
    if not rows:
        raise LogError("a blackbox without a frame: was it armed?")
    values = np.array([[np.nan if v == "" else v for v in row] for row in rows], float)
    raw = dict(zip(names, values.T, strict=True))
    headers = {name.replace(" ", ""): str(value) for name, value in parser.headers.items()}
    # as the CSV's headers have it: 'Betaflight 4.4.0 (...)'
    revision = re.search(r"\d+\.\d+", headers.get("Firmwarerevision", ""))
    headers["firmwareVersion"] = revision[0] if revision else "4"
    remarks = [f"of {logs} logs in the file the first is read"] * (logs > 1)
    fields = _fields(names)
    remarks += _without_filter(fields)
    return _table(_Blackbox(path.name, raw, fields, headers), mapping, remarks)


def read_blackbox_csv(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """A decoded blackbox. Raises LogError where it lacks what is needed."""
    delimiter = delimiter_of(mapping)
    lines = head_of(path)
    above = _lines_above(lines) or 0
    names = find_header(lines[above:], delimiter).names
    headers = _headers(lines[:above])
    log_file = path.with_name(path.name.removesuffix(".gz").removesuffix(".csv") + HEADERS_FILE)
    if log_file.is_file():
        # what a decoder put beside the table goes before what stands above it
        headers |= _headers(head_of(log_file))
    fields = _fields(names)
    remarks = _without_filter(fields)
    time = fields.get("time", "time")
    mapping_columns = {} if mapping is None else mapping.columns
    sources = (*_usual(fields, headers).values(), *mapping_columns.values())
    columns_read = (time, *(source.name for source in sources))
    raw, more_remarks = raw_columns(path, columns_read, time, delimiter, above)
    return _table(_Blackbox(path.name, raw, fields, headers), mapping, [*remarks, *more_remarks])


def _fields(names: list[str]) -> dict[str, str]:
    """{field: the column's name} of a log's columns. Raises LogError for more motors than
    four: a hexacopter's first four would be read as a quad's.
    """
    fields = {_FIELD.fullmatch(name)[1]: name for name in names}
    if "motor[4]" in fields:
        raise LogError("more than four motors were logged; four are needed")
    return fields


@dataclass(frozen=True, eq=False)
class _Blackbox:
    """A blackbox as it was read: raw values by the columns' names, the column of each
    field, and the log's headers.
    """

    name: str
    raw: dict[str, np.ndarray]
    fields: dict[str, str]
    headers: dict[str, str]


def _table(log: _Blackbox, mapping: ColumnMapping | None, remarks: list[str]) -> LogTable:
    """The log's table of its fields' raw values."""
    fields = log.fields
    time = fields.get("time", "time")
    mapping_columns = {} if mapping is None else mapping.columns
    raw = log.raw | _east_north_up(log.raw, fields)
    columns = _usual(fields, log.headers) | {c: Source(c) for c in _POSE if c in raw}
    columns |= _force(raw, fields, log.headers, remarks) | _motors(raw, fields, remarks)
    if mapping is not None:
        columns = mapping.over(columns)
    seconds = raw[time] * UNITS.get(_FIELD.fullmatch(time)[2] or "us", UNITS["us"])
    table = merge_streams([Stream(seconds, raw)], columns)
    table["t"] = table["t"] - table["t"][0]
    for motor in set(CHANNEL_COLUMNS["motor_command"]) & set(table) - set(mapping_columns):
        # a motor at rest is below DShot's least
        table[motor] = np.maximum(table[motor], 0.0)
    return LogTable(log.name, table, np.full(len(table["t"]), "0"), tuple(remarks))


def _without_filter(fields: dict[str, str]) -> list[str]:
    """Takes `gyroUnfilt` for a `gyroADC` that wasn't logged, and says so. Raises
    LogError where neither was.
    """
    if "gyroADC[0]" in fields:
        return []
    if "gyroUnfilt[0]" not in fields:
        raise LogError("no gyroscope was logged (gyroADC[0..2]): switch it on in the blackbox")
    fields |= {f"gyroADC[{i}]": fields[f"gyroUnfilt[{i}]"] for i in range(3)}
    return ["gyroADC wasn't logged: gyroUnfilt, before Betaflight's filters, is read instead"]


def _usual(fields: dict[str, str], headers: dict[str, str]) -> dict[str, Source]:
    """{column: source} of fields that are there, whose scale the log's headers have
    `said`. The force and the motors are raw as yet.
    """
    # without the header nothing is said of it, and blackboxes are coarse by default
    fine = FINE if _number(headers, "blackbox_high_resolution") else 1.0
    # The Explorer's gyroScale is in rad/us a count.
    count = 1e6 * (_number(headers, "gyroScale") or UNITS["us"] * UNITS["deg/s"])
    old = headers.get("firmwareVersion", "4").startswith(("2.", "3."))
    channels = {f"w{a}": (f"gyroADC[{i}]", count / fine) for i, a in enumerate("xyz")}
    channels |= {
        f"cmd_w{a}": (f"setpoint[{i}]", UNITS["deg/s"] / fine) for i, a in enumerate("xyz")
    }
    channels |= {f"a{a}": (f"accSmooth[{i}]", 1.0) for i, a in enumerate("xyz")}
    channels |= {column: (f"motor[{i}]", 1.0) for column, i in MOTOR_OF.items()}
    channels |= {"cmd_thrust": ("setpoint[3]", 1e-3)}
    # Indiflight's own, rad/s, or hundreds of electrical revolutions in a minute
    pole_pairs = (_number(headers, "motor_poles") or 14.0) / 2.0
    for rotor, i in MOTOR_OF.items():
        speed = ("omegaUnfiltered", 1.0) if "omegaUnfiltered[0]" in fields else ("omega", 1.0)
        speed = speed if f"{speed[0]}[0]" in fields else ("eRPM", 100.0 * UNITS["rpm"] / pole_pairs)
        channels[rotor.replace("m", "w")] = (f"{speed[0]}[{i}]", speed[1])
    # up to Betaflight 3 the battery was logged in tenths of a volt
    channels |= {"vbat": ("vbatLatest", 0.1 if old else 0.01)}
    return {
        column: Source(fields[field], _scale(fields[field], usual))
        for column, (field, usual) in channels.items()
        if field in fields
    }


def _east_north_up(raw, fields: dict[str, str]) -> dict[str, np.ndarray]:
    """Pose and velocity as Indiflight logs them, in north, east, down and forward, right,
    down, in the log format's frames: of motion capture where that was logged.
    """
    columns = {}
    for axis, (index, sign) in {"x": (1, 1.0), "y": (0, 1.0), "z": (2, -1.0)}.items():
        for column, names, unit in (
            (axis, ("extPos", "pos"), 1e-3),
            (f"v{axis}", ("extVel", "vel"), 1e-2),
        ):
            name = next((fields[f"{n}[{index}]"] for n in names if f"{n}[{index}]" in fields), "")
            if name in raw and np.ptp(raw[name][np.isfinite(raw[name])]) > 0.0:
                columns[column] = sign * unit * raw[name]
    attitude = [raw.get(fields.get(f"quat[{i}]")) for i in range(4)]
    if all(values is not None for values in attitude):
        w, x, y, z = (values / QUATERNION_UNIT for values in attitude)
        half = np.sqrt(0.5)
        columns |= {"qw": half * (w + z), "qx": half * (x + y)}
        columns |= {"qy": half * (x - y), "qz": half * (w - z)}
    return columns


def _number(headers: dict[str, str], name: str) -> float:
    """A header's number; 0 where there is none."""
    try:
        return float(headers.get(name, 0.0))
    except ValueError:
        return 0.0


def _scale(name: str, usual: float) -> float:
    """The factor of a field to the log format's unit: that in its brackets, or the usual one."""
    unit = _FIELD.fullmatch(name)[2]
    return usual if unit is None else UNITS.get(_UNIT_NAMES.get(unit, unit), usual)


def _force(
    raw, fields: dict[str, str], headers: dict[str, str], remarks: list[str]
) -> dict[str, Source]:
    """The accelerometer's columns. Raw counts are as many a g as the header acc_1G
    says; without it, sensors have a power of two for 1 g, and it is the one nearest to
    what was felt in the median.
    """
    names = [fields.get(f"accSmooth[{i}]") for i in range(3)]
    if any(name is None or name not in raw for name in names) or "(" in names[0]:
        return {}
    counts = _number(headers, "acc_1G")
    if not counts:
        magnitude = np.nanmedian(np.linalg.norm([raw[name] for name in names], axis=0))
        counts = 2.0 ** np.rint(np.log2(max(magnitude, 1.0)))
        remarks.append(f"accSmooth is in the sensor's counts: {counts:g} are taken for 1 g")
    return {
        f"a{a}": Source(name, UNITS["g"] / counts) for a, name in zip("xyz", names, strict=True)
    }


def _motors(raw, fields: dict[str, str], remarks: list[str]) -> dict[str, Source]:
    """The motors' columns, as shares of the range of the protocol that they show:
    pulses are never below their least, and DShot's largest is beyond that of pulses.
    """
    names = {c: fields[f"motor[{i}]"] for c, i in MOTOR_OF.items() if f"motor[{i}]" in fields}
    values = [raw[name] for name in names.values() if name in raw]
    if not values:
        return {}
    low = min(float(np.nanmin(v)) for v in values)
    high = max(float(np.nanmax(v)) for v in values)
    digital = low < PULSE[0] - 1.0 or high > PULSE[1] + 1.0
    least, most = DSHOT if digital else PULSE
    kind = "DShot values" if digital else "pulses in us"
    remarks.append(
        f"motor[0..3] reach from {low:g} to {high:g}: taken for {kind}, {least:g}..{most:g}"
    )
    scale = 1.0 / (most - least)
    return {c: Source(name, scale, -least * scale) for c, name in names.items()}


CSV_IMPORTER = Importer("Betaflight blackbox CSV", is_blackbox_csv, read_blackbox_csv)
BINARY_IMPORTER = Importer("Betaflight blackbox", is_blackbox_binary, read_blackbox_binary)

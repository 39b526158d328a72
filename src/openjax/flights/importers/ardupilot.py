"""ArduPilot's DataFlash logs (`.bin`), through the `pymavlink` library.

ArduPilot's world is north, east, down and its body forward, right, down; here they are east, north,
up and forward, left, up. Motors are those of a quad X, on the outputs that SERVOi_FUNCTION names; a
pulse between MOT_PWM_MIN and MOT_PWM_MAX is turned into thrust by ArduPilot's own curve, thrust = e
s^2 + (1 - e) s with e = MOT_THST_EXPO (AP_Motors_Thrust_Linearization.cpp).
"""

import contextlib
import io
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from openjax.errors import UserError
from openjax.flights.csv_text import LARGEST, LogError
from openjax.flights.importers.columns import UNITS, ColumnMapping, Source
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import CHANNEL_COLUMNS, LogTable

MAGIC = b"\xa3\x95\x80"
MOTOR_1 = 33  # SERVOi_FUNCTION of motor 1
PULSE = (1000.0, 2000.0)  # us, the defaults of MOT_PWM_MIN and MOT_PWM_MAX
EXPONENT = 0.65  # the default of MOT_THST_EXPO
QUAD, X = 1, 1  # of FRAME_CLASS and FRAME_TYPE
# ArduPilot's motors 1 to 4: front right, rear left, front left, rear right
PLACES = ("m1", "m3", "m4", "m2")
MOST_OUTPUTS = 14  # of RCOU
DEGREE = UNITS["deg/s"]

# {message: {column: (field, scale)}} in the frames of the log format; of two messages that
# hold a column the first.
MESSAGES: dict[str, dict[str, tuple[str, float]]] = {
    "IMU": {
        "wx": ("GyrX", 1.0),
        "wy": ("GyrY", -1.0),
        "wz": ("GyrZ", -1.0),
        "ax": ("AccX", 1.0),
        "ay": ("AccY", -1.0),
        "az": ("AccZ", -1.0),
    },
    "XKF1": {
        "x": ("PE", 1.0),
        "y": ("PN", 1.0),
        "z": ("PD", -1.0),
        "vx": ("VE", 1.0),
        "vy": ("VN", 1.0),
        "vz": ("VD", -1.0),
    },
    "RATE": {
        "cmd_wx": ("RDes", DEGREE),
        "cmd_wy": ("PDes", -DEGREE),
        "cmd_wz": ("YDes", -DEGREE),
        "cmd_thrust": ("AOut", 1.0),
    },
    "BAT": {"vbat": ("Volt", 1.0)},
    "CURR": {"vbat": ("Volt", 1.0)},
}
MESSAGES["NKF1"] = MESSAGES["XKF1"]
INSTANCE = ("I", "C", "Instance")
"""Fields that count sensors, cores and batteries, of which the first is read."""


def is_dataflash(path: Path) -> bool:
    """True if a file starts like a DataFlash log."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def read_dataflash(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """Read a DataFlash log. With a mapping, sources are "MESSAGE:FIELD" in ArduPilot's frames
    and units; what it doesn't name is recognised.

    Raises LogError if it is damaged or holds nothing known, UserError without the library.
    """
    more = {} if mapping is None else mapping.over({})
    streams, parameters = _parse(path, {source.name.partition(":")[0] for source in more.values()})
    if "ATT" in streams:
        streams["ATT"] = _turn(streams["ATT"])
    streams |= _rotors(streams, parameters)
    columns: dict[str, Source] = {}
    for message, fields in MESSAGES.items():
        for column, (field, scale) in fields.items():
            if f"{message}:{field}" in getattr(streams.get(message), "values", ()):
                columns.setdefault(column, Source(f"{message}:{field}", scale))
    channels = ("quaternion", "motor_command", "rotor_speed")
    names = {name for stream in streams.values() for name in stream.values}
    columns |= {
        c: Source(c) for channel in channels for c in CHANNEL_COLUMNS[channel] if c in names
    }
    if mapping is not None:
        columns = mapping.over(columns)
    table = merge_streams(list(streams.values()), columns)
    table["t"] = table["t"] - table["t"][0]
    return LogTable(path.name, table, np.full(len(table["t"]), "0"))


def _parse(path: Path, more: set[str]) -> tuple[dict[str, Stream], dict[str, float]]:
    """The messages that are known and `more` as streams, each of its first instance, and
    the parameters. Raises as `read_dataflash` does.
    """
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError as error:
        raise UserError(
            f"{path}: reading ArduPilot logs needs the pymavlink library: pip install pymavlink"
        ) from error
    if path.stat().st_size > LARGEST:
        raise LogError(f"holds more than {LARGEST >> 20} MB: cut it into flights")
    types = [*MESSAGES, "ATT", "RCOU", "ESC", "PARM", *more]
    rows: dict[str, list[dict]] = defaultdict(list)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it tells of damages there
            log = DFReader_binary(str(path))
            while (message := log.recv_match(type=types)) is not None:
                rows[message.get_type()].append(message.to_dict())
    except Exception as error:  # damaged logs raise many kinds; all mean the same here
        words = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f"ArduPilot log can't be read: {words}") from error
    parameters = {row["Name"]: float(row["Value"]) for row in rows.pop("PARM", [])}
    return _streams(rows), parameters


def _streams(rows: dict[str, list[dict]]) -> dict[str, Stream]:
    """Messages as streams, each of its first instance, but for the ESCs: one of each."""
    streams = {}
    for name, of_message in rows.items():
        if name == "ESC":
            by_motor = {row.get("Instance") for row in of_message}
            for motor in by_motor:
                own_rows = [row for row in of_message if row.get("Instance") == motor]
                streams[f"ESC{motor}"] = _stream(f"ESC{motor}", own_rows)
            continue
        key = next((field for field in INSTANCE if field in of_message[0]), "")
        first = min(row[key] for row in of_message) if key else 0
        streams[name] = _stream(name, [row for row in of_message if not key or row[key] == first])
    return {n: s for n, s in streams.items() if len(s.time) > 1}


def _stream(name: str, rows: list[dict]) -> Stream:
    """Rows of a message as a stream of "MESSAGE:FIELD", in seconds since the start."""
    time = np.array([row["TimeUS"] for row in rows], float) * 1e-6
    numbers = [n for n, v in rows[0].items() if isinstance(v, int | float)]
    return Stream(time, {f"{name}:{n}": np.array([r[n] for r in rows], float) for n in numbers})


def _turn(stream: Stream) -> Stream:
    """The attitude's stream with the quaternion of the log format."""
    roll, pitch, yaw = (np.radians(stream.values[f"ATT:{n}"]) for n in ("Roll", "Pitch", "Yaw"))
    angles = np.stack([0.5 * np.pi - yaw, -pitch, roll], 1)
    attitude = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    columns = dict(zip(CHANNEL_COLUMNS["quaternion"], attitude.T, strict=True))
    return Stream(stream.time, stream.values | columns)


def _rotors(streams: dict[str, Stream], parameters: dict[str, float]) -> dict[str, Stream]:
    """Streams of the motors' thrusts and of the rotors' speeds, those that were logged.
    Raises LogError for a frame that is no quad X.
    """
    frame = [parameters.get("FRAME_CLASS", QUAD), parameters.get("FRAME_TYPE", X)]
    if frame != [QUAD, X]:
        raise LogError(
            f"FRAME_CLASS is {frame[0]:g} and FRAME_TYPE {frame[1]:g}; a quad X, 1 and 1, is needed"
        )
    functions = {parameters.get(f"SERVO{n}_FUNCTION"): n for n in range(1, MOST_OUTPUTS + 1)}
    outputs = [functions.get(MOTOR_1 + motor, motor + 1) for motor in range(4)]
    least, most = (
        parameters.get(f"MOT_PWM_{n}", p) for n, p in zip(("MIN", "MAX"), PULSE, strict=True)
    )
    bend = parameters.get("MOT_THST_EXPO", EXPONENT)
    rotors = {}
    for column, output in zip(PLACES, outputs, strict=True):
        pulses = getattr(streams.get("RCOU"), "values", {}).get(f"RCOU:C{output}")
        if pulses is not None:
            signal = np.clip((pulses - least) / max(most - least, 1.0), 0.0, 1.0)
            thrust = bend * signal**2 + (1.0 - bend) * signal
            rotors.setdefault("motors", Stream(streams["RCOU"].time, {})).values[column] = thrust
        esc = streams.get(f"ESC{output - 1}")
        if esc is not None and f"ESC{output - 1}:RPM" in esc.values:
            speed = UNITS["rpm"] * esc.values[f"ESC{output - 1}:RPM"]
            rotors[f"rotor {column}"] = Stream(esc.time, {column.replace("m", "w"): speed})
    return rotors


IMPORTER = Importer("ArduPilot DataFlash", is_dataflash, read_dataflash)

"""PX4's ULog files (`.ulg`), through the `pyulog` library.

PX4's world is north, east, down and its body forward, right, down; here they are east, north, up
and forward, left, up. Motors are put into the nominal order by the places that the log's parameters
give them (CA_ROTORi_PX, _PY, metres forward and right), or by PX4's quad X.

`actuator_motors` holds shares of the largest thrust. Where it wasn't logged, `actuator_outputs` is
taken between its least and largest value, and turned into thrust by PX4's own curve, thrust = f s^2
+ (1 - f) s with f = THR_MDL_FAC (FunctionMotors.hpp).
"""

import contextlib
import io
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.csv_text import LARGEST, LogError
from openjax.flights.importers.columns import ColumnMapping, Source
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import LogTable

MAGIC = b"ULog\x01\x12\x35"
QUAD_X = ("front_right", "rear_left", "front_left", "rear_right")  # PX4's motors 1 to 4
COLUMN_OF = {"front_right": "m1", "rear_right": "m2", "rear_left": "m3", "front_left": "m4"}
PULSE = (1000.0, 2000.0)  # us, PX4's defaults of PWM_MIN and PWM_MAX
SELDOM = 3  # values outside of its range that an output may have
MOTOR_1 = 101  # the output function of motor 1 in PWM_MAIN_FUNCi

# Topics and, in the frames of the log format, the columns that they hold: (field, scale).
TOPICS: dict[str, dict[str, tuple[str, float]]] = {
    "vehicle_local_position": {
        "x": ("y", 1.0),
        "y": ("x", 1.0),
        "z": ("z", -1.0),
        "vx": ("vy", 1.0),
        "vy": ("vx", 1.0),
        "vz": ("vz", -1.0),
    },
    "sensor_combined": {
        "wx": ("gyro_rad[0]", 1.0),
        "wy": ("gyro_rad[1]", -1.0),
        "wz": ("gyro_rad[2]", -1.0),
        "ax": ("accelerometer_m_s2[0]", 1.0),
        "ay": ("accelerometer_m_s2[1]", -1.0),
        "az": ("accelerometer_m_s2[2]", -1.0),
    },
    "vehicle_angular_velocity": {
        "wx": ("xyz[0]", 1.0),
        "wy": ("xyz[1]", -1.0),
        "wz": ("xyz[2]", -1.0),
    },
    "vehicle_acceleration": {"ax": ("xyz[0]", 1.0), "ay": ("xyz[1]", -1.0), "az": ("xyz[2]", -1.0)},
    "vehicle_rates_setpoint": {
        "cmd_thrust": ("thrust_body[2]", -1.0),
        "cmd_wx": ("roll", 1.0),
        "cmd_wy": ("pitch", -1.0),
        "cmd_wz": ("yaw", -1.0),
    },
    "battery_status": {"vbat": ("voltage_v", 1.0)},
}
ATTITUDE = "vehicle_attitude"
MOTORS = "actuator_motors"
OUTPUTS = "actuator_outputs"


def is_ulog(path: Path) -> bool:
    """True if a file starts like a ULog, or is called like one."""
    if not path.is_file():
        return False
    if path.suffix.lower() == ".ulg":
        return True
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def read_ulog(path: Path, mapping: ColumnMapping | None = None) -> LogTable:
    """Read a ULog. With a mapping, sources are "TOPIC:FIELD" in PX4's frames and units; what it
    doesn't name is recognised.

    Raises LogError if it is damaged or holds nothing known, UserError without the library.
    """
    mapping_columns = {} if mapping is None else mapping.over({})
    log = _parse(path, {source.name.partition(":")[0] for source in mapping_columns.values()})
    # of several sensors of a kind the first
    topics = {
        data.name: data for data in log.data_list if data.multi_id == 0 and "timestamp" in data.data
    }
    streams = {name: _stream(data, log.start_timestamp) for name, data in topics.items()}
    if f"{ATTITUDE}:q[0]" in streams.get(ATTITUDE, Stream(np.empty(0), {})).values:
        streams[ATTITUDE] = _turn(streams[ATTITUDE])
    motors, remarks = _motors(streams, log.initial_parameters)
    if motors is not None:
        streams["motors"] = motors
    # the fastest stream is the table's clock, and of two that hold a column the faster
    # one goes first
    fastest_first = sorted(streams.values(), key=_period)
    columns = _columns(fastest_first)
    if mapping is not None:
        columns = mapping.over(columns)
    if log.dropouts:
        seconds_lost = sum(dropout.duration for dropout in log.dropouts)
        remarks.append(
            f"{len(log.dropouts)} dropouts of {seconds_lost} ms in all while it was logged"
        )
    if log.file_corruption:
        remarks.append("the log is corrupt in places; the rest of it is read")
    table = merge_streams(fastest_first, columns)
    table["t"] = table["t"] - table["t"][0]
    return LogTable(path.name, table, np.full(len(table["t"]), "0"), tuple(remarks))


def _parse(path: Path, more: set[str]):
    """The library's log of the topics that are known and `more`. Raises as `read_ulog` does."""
    try:
        from pyulog import ULog
    except ImportError as error:
        raise UserError(
            f"{path}: reading PX4 logs needs the pyulog library: pip install pyulog"
        ) from error
    if path.stat().st_size > LARGEST:
        raise LogError(f"holds more than {LARGEST >> 20} MB: cut it into flights")
    topics = {*TOPICS, ATTITUDE, MOTORS, OUTPUTS, *more}
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it warns of damages there
            log = ULog(str(path), sorted(topics))
    except Exception as error:  # damaged logs raise many kinds; all mean the same here
        words = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f"PX4 log can't be read: {words}") from error
    if not log.data_list:
        raise LogError(
            "a PX4 log without a flight: none of the topics sensor_combined, vehicle_attitude, "
            "vehicle_local_position, actuator_motors"
        )
    return log


def _stream(data, start: int) -> Stream:
    """A topic as a stream of "TOPIC:FIELD", in seconds since the log's start: when it
    was measured where that is logged, else when it was published.
    """
    fields = data.data
    stamp = np.asarray(fields["timestamp"], np.int64)
    sample_times = fields.get("timestamp_sample")
    # a driver that doesn't know when it sampled writes zeros
    if sample_times is not None and np.all(sample_times > 0):
        stamp = np.asarray(sample_times, np.int64)
    values = {f"{data.name}:{name}": np.asarray(v, float) for name, v in fields.items()}
    return Stream((stamp - int(start)) * 1e-6, values)


def _period(stream: Stream) -> float:
    """s between rows; sensors of one rate count as equally fast."""
    steps = np.diff(stream.time)
    return round(float(np.median(steps)), 4) if len(steps) else np.inf


def _turn(stream: Stream) -> Stream:
    """The attitude's stream with the quaternion of the log format, body (forward, left, up) to
    world (east, north, up): q' = (i + j)/sqrt(2) q i*, of q from body to world in PX4's frames.
    """
    w, x, y, z = (stream.values[f"{ATTITUDE}:q[{i}]"] for i in range(4))
    half = np.sqrt(0.5)
    values_of = {
        "qw": half * (w + z),
        "qx": half * (x + y),
        "qy": half * (x - y),
        "qz": half * (w - z),
    }
    return Stream(stream.time, stream.values | values_of)


def _columns(streams: list[Stream]) -> dict[str, Source]:
    """{column: source} of what was logged, by the first stream that has it."""
    sources: dict[str, Source] = {}
    fields_of = {
        f"{topic}:{field}": (column, scale)
        for topic, columns in TOPICS.items()
        for column, (field, scale) in columns.items()
    }
    identity = {c: (c, 1.0) for c in ("qw", "qx", "qy", "qz", *COLUMN_OF.values())}
    for stream in streams:
        for name in stream.values:
            if name in fields_of or name in identity:
                column, scale = (fields_of | identity)[name]
                sources.setdefault(column, Source(name, scale))
    return sources


def _motors(streams, parameters) -> tuple[Stream | None, list[str]]:
    """The motors' thrusts as a stream of m1 to m4, and remarks; None where neither
    motors nor outputs were logged. Raises LogError for another number of rotors.
    """
    places = _places(parameters)
    if MOTORS in streams:
        stream = streams[MOTORS]
        thrust = _fields(stream, [f"{MOTORS}:control[{i}]" for i in range(4)])
    elif OUTPUTS in streams:
        stream = streams[OUTPUTS]
        outputs = [_output_of(motor, parameters) for motor in range(4)]
        values = _fields(stream, [f"{OUTPUTS}:output[{o}]" for o in outputs])
        signals = [_signal(v, o, parameters) for v, o in zip(values, outputs, strict=True)]
        curve = float(parameters.get("THR_MDL_FAC", 0.0))
        # PX4's own model of a motor, by which it turns thrust into a signal
        thrust = [curve * s**2 + (1.0 - curve) * s for s in signals]
    else:
        return None, []
    remarks = [] if MOTORS in streams else ["motors are taken from actuator_outputs"]
    columns = {COLUMN_OF[place]: values for place, values in zip(places, thrust, strict=True)}
    spins = [parameters.get(f"CA_ROTOR{i}_KM") for i in range(4)]
    if None not in spins:
        turns = {p: "ccw" if spin > 0 else "cw" for p, spin in zip(places, spins, strict=True)}
        order = ", ".join(f'"{turns[place]}"' for place in COLUMN_OF)
        remarks.append(f"by the log's parameters, motor.spin in vehicle.toml is [{order}]")
    return Stream(stream.time, columns), remarks


def _fields(stream: Stream, names: list[str]) -> list[np.ndarray]:
    """The values of a topic's fields. Raises LogError for one that it hasn't."""
    absent = next((name for name in names if name not in stream.values), None)
    if absent is not None:
        raise LogError(f"no {absent} in the log; four motors are needed")
    return [stream.values[name] for name in names]


def _places(parameters) -> tuple[str, ...]:
    """The places of PX4's motors 1 to 4. Raises LogError unless they are four corners."""
    count = int(parameters.get("CA_ROTOR_COUNT", 4))
    if count != 4:
        raise LogError(f"the airframe has {count} rotors (CA_ROTOR_COUNT); four are needed")
    corners = [[parameters.get(f"CA_ROTOR{i}_P{a}") for a in "XY"] for i in range(4)]
    if any(None in corner for corner in corners):
        return QUAD_X
    places = tuple(
        f"{'front' if x > 0 else 'rear'}_{'right' if y > 0 else 'left'}" for x, y in corners
    )
    if set(places) != set(COLUMN_OF):
        raise LogError(f"rotors sit at {', '.join(places)} (CA_ROTORi_PX, _PY): no quad X")
    return places


def _output_of(motor: int, parameters) -> int:
    """Index of the output that a motor, from 0 on, is on: by PWM_MAIN_FUNCi, or its own
    number. Raises LogError where it is on outputs of another kind.
    """
    elsewhere = [n for n, f in parameters.items() if "_FUNC" in n and f == MOTOR_1 + motor]
    if elsewhere and not elsewhere[0].startswith("PWM_MAIN"):
        raise LogError(
            f"motor {motor + 1} is on {elsewhere[0]}, and the first actuator_outputs are the main "
            "ones: log actuator_motors"
        )
    functions = {i: parameters.get(f"PWM_MAIN_FUNC{i + 1}") for i in range(16)}
    return next((i for i, f in functions.items() if f == MOTOR_1 + motor), motor)


def _signal(output: np.ndarray, index: int, parameters) -> np.ndarray:
    """An output as a share of its range. Raises LogError where that isn't its range."""
    least = _end_of_range("MIN", index, parameters, PULSE[0])
    most = _end_of_range("MAX", index, parameters, PULSE[1])
    # a motor that is disarmed has one value or two below the least
    beyond = np.unique(output[(output < least) | (output > most)])
    if len(beyond) > SELDOM:
        raise LogError(
            f"actuator_outputs reach from {np.nanmin(output):g} to {np.nanmax(output):g}, and "
            f"their range is {least:g} to {most:g} (PWM_MIN, PWM_MAX): DShot? Log actuator_motors"
        )
    return np.clip((output - least) / max(most - least, 1.0), 0.0, 1.0)


def _end_of_range(end: str, index: int, parameters, usual: float) -> float:
    """The least or largest pulse of an output, in us: its own parameter, or that of all
    outputs, of which PX4 up to 1.12 says -1 ("as all") or nothing.
    """
    names = (f"PWM_MAIN_{end}{index + 1}", f"PWM_MAIN_{end}", f"PWM_{end}")
    values = (float(parameters.get(name, -1.0)) for name in names)
    return next((value for value in values if value > 0.0), usual)


IMPORTER = Importer("PX4 ULog", is_ulog, read_ulog)

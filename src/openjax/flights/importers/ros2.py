"""ROS 2 bags (SQLite or MCAP), through the `rosbags` library; no ROS installation is needed.

Without a column mapping, topics are recognised by their message types, and a topic's namespace
("/cf1" of "/cf1/imu") is the vehicle. Times are the messages' header stamps where they have one,
else the bag's receive times.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.importers.columns import ColumnMapping, Source, Stream, merge_streams
from openjax.flights.importers.crazyswarm import (
    DEFINITIONS,
    LOG_TYPE,
    custom_topics,
    log_stream,
    variables_of,
)
from openjax.flights.importers.firmware import firmware_columns
from openjax.flights.importers.importer import Importer
from openjax.flights.reading import CHANNEL_COLUMNS, LogError, LogTable

_POSITION = CHANNEL_COLUMNS["position"]
_QUATERNION = CHANNEL_COLUMNS["quaternion"]


def _pose(position: str, orientation: str) -> dict[str, str]:
    fields = {c: f"{position}.{c}" for c in _POSITION}
    return fields | {c: f"{orientation}.{c[1]}" for c in _QUATERNION}


_RATES = {f"w{a}": f"angular_velocity.{a}" for a in "xyz"}
_FORCE = {f"a{a}": f"linear_acceleration.{a}" for a in "xyz"}

# Fields of the message types that say what they hold: column -> field. An odometry's twist is left
# out: it is in the body frame, and velocity can be derived from position.
KNOWN_TYPES = {
    "sensor_msgs/msg/Imu": _RATES | _FORCE,
    "geometry_msgs/msg/PoseStamped": _pose("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose(
        "pose.pose.position", "pose.pose.orientation"
    ),
    "geometry_msgs/msg/TransformStamped": _pose("transform.translation", "transform.rotation"),
    "nav_msgs/msg/Odometry": _pose("pose.pose.position", "pose.pose.orientation"),
    "sensor_msgs/msg/BatteryState": {"vbat": "voltage"},
    "crazyflie_interfaces/msg/Status": {"vbat": "battery_voltage"},
    "mavros_msgs/msg/AttitudeTarget": {"cmd_thrust": "thrust"}
    | {f"cmd_w{a}": f"body_rate.{a}" for a in "xyz"},
    "actuator_msgs/msg/Actuators": {f"m{i + 1}": f"normalized[{i}]" for i in range(4)},
}
# Types that say nothing: taken by what the topic's last name contains.
_ARRAY_TYPES = {"std_msgs/msg/Float32MultiArray", "std_msgs/msg/Float64MultiArray"}
_ARRAY_NAMES = {
    "motor": {f"m{i + 1}": f"data[{i}]" for i in range(4)},
    "command": {"cmd_thrust": "data[0]"}
    | {f"cmd_w{a}": f"data[{i + 1}]" for i, a in enumerate("xyz")},
}


def is_bag(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / "metadata.yaml").is_file()


def read_bag(path: str | Path, mapping: ColumnMapping | None = None) -> LogTable:
    """Read a ROS 2 bag. With a mapping, sources are "TOPIC:FIELD" ("/cf1/imu:angular_velocity.x",
    "/m:data[0]").

    Raises LogError if the bag can't be read or holds nothing known, UserError without the rosbags
    library.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise UserError(
            f"{path}: reading ROS 2 bags needs the rosbags library: pip install rosbags"
        ) from error
    path = Path(path)
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    try:
        with AnyReader([path], default_typestore=store) as reader:
            vehicles, remarks = _vehicles(reader, mapping, path)
    except LogError:
        raise
    except Exception as error:  # the library raises many kinds for a damaged bag; all mean the same
        raise LogError(
            f"ROS 2 bag can't be read: {str(error).splitlines()[0] if str(error) else type(error)}"
        ) from error
    return _joined(path.name, *_merged(vehicles, remarks, mapping))


@dataclass(eq=False)
class _Recording:
    """What a bag holds of one vehicle: streams of topics, sources of columns that their types name,
    and streams of log variables on the firmware's clock, which is `ahead` s behind the bag's.
    """

    streams: list[Stream] = field(default_factory=list)
    columns: dict[str, Source] = field(default_factory=dict)
    log_streams: list[Stream] = field(default_factory=list)
    ahead: list[float] = field(default_factory=list)

    def all_streams(self) -> list[Stream]:
        """On one clock. The radio delays a message, never hastens it, so that the least that a
        stamp is ahead of its tick is what the clocks are apart.
        """
        ahead = min(self.ahead, default=0.0)
        moved = [Stream(stream.time + ahead, stream.values) for stream in self.log_streams]
        return [*moved, *self.streams]


def _vehicles(
    reader, mapping: ColumnMapping | None, path: Path
) -> tuple[dict[str, _Recording], list[str]]:
    """{vehicle: what the bag holds of it}, and remarks. With a mapping all is one vehicle's."""
    wanted = _wanted(reader.connections, mapping)
    files = custom_topics(path) if mapping is None else []
    vehicles: dict[str, _Recording] = {}
    remarks = []
    for connection in reader.connections:
        topic = connection.topic
        vehicle = "" if mapping is not None else topic.rpartition("/")[0]
        if topic in wanted:
            recording = vehicles.setdefault(vehicle, _Recording())
            recording.streams.append(_stream(reader, connection, wanted[topic]))
            recording.columns |= {c: Source(f"{topic}:{f}") for c, f in wanted[topic].items()}
        elif mapping is None and connection.msgtype == LOG_TYPE:
            variables = variables_of(topic, files)
            if variables is None:
                remarks.append(
                    f"{topic} holds values without names: put the crazyflies.yaml that names them "
                    "beside the bag"
                )
                continue
            messages = list(_messages(reader, connection))
            if messages:
                stream, ahead = log_stream(topic, variables, messages)
                recording = vehicles.setdefault(vehicle, _Recording())
                recording.log_streams.append(stream)
                recording.ahead.append(ahead)
    return vehicles, remarks


def _merged(
    vehicles: dict[str, _Recording], remarks: list[str], mapping: ColumnMapping | None
) -> tuple[dict[str, dict], list[str]]:
    """The columns of each vehicle, and remarks on those that hold none. Raises LogError if none
    does.
    """
    tables = {}
    for vehicle, recording in vehicles.items():
        if mapping is not None:
            columns = {c: s for c, s in mapping.columns.items() if c not in ("t", "vehicle")}
        else:
            by_name, found = firmware_columns(recording.log_streams)
            columns = recording.columns | by_name
            remarks += found
        try:
            tables[vehicle.strip("/") or "0"] = merge_streams(recording.all_streams(), columns)
        except LogError as error:
            remarks.append(f"topics of {vehicle or '/'}: {error}")
    if not tables:
        raise LogError(
            "; ".join(remarks) or "holds no topic of a known type; name its topics in columns.toml"
        )
    return tables, remarks


def _wanted(connections, mapping: ColumnMapping | None) -> dict[str, dict[str, str]]:
    """Topic -> {column: field} of what is to be read."""
    wanted: dict[str, dict[str, str]] = {}
    if mapping is not None:
        for column, source in mapping.columns.items():
            topic, separator, field = source.name.partition(":")
            if separator and column not in ("t", "vehicle"):
                wanted.setdefault(topic, {})[column] = field
        return wanted
    for connection in connections:
        fields = KNOWN_TYPES.get(connection.msgtype)
        if connection.msgtype in _ARRAY_TYPES:
            last = connection.topic.rpartition("/")[2].lower()
            fields = next((f for word, f in _ARRAY_NAMES.items() if word in last), None)
        if fields is not None:
            wanted[connection.topic] = fields
    return wanted


def _stream(reader, connection, fields: dict[str, str]) -> Stream:
    """The wanted fields of one topic, named "TOPIC:FIELD"."""
    times = []
    rows = []
    for stamp, message in _messages(reader, connection):
        times.append(stamp)
        rows.append([_field(message, field, connection.topic) for field in fields.values()])
    values = np.asarray(rows, float).reshape(len(rows), len(fields))
    named = {
        f"{connection.topic}:{field}": column
        for field, column in zip(fields.values(), values.T, strict=True)
    }
    return Stream(np.asarray(times, float) * 1e-9, named)


def _messages(reader, connection):
    """(stamp, message) of a topic: integer nanoseconds since the bag's start, which keep their
    resolution as floats of seconds; the header's where there is one, else when it was received.
    """
    for _, received, data in reader.messages(connections=[connection]):
        message = reader.deserialize(data, connection.msgtype)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        nanoseconds = 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec
        yield (nanoseconds or received) - reader.start_time, message


def _field(message, path: str, topic: str) -> float:
    try:
        for name, index in re.findall(r"(\w+)|\[(\d+)\]", path):
            message = message[int(index)] if index else getattr(message, name)
        return float(message)
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise LogError(f"messages of {topic} have no number {path!r}") from error


def _joined(name: str, tables: dict[str, dict[str, np.ndarray]], remarks: list[str]) -> LogTable:
    """The vehicles' columns in the long format, time from the first row of any."""
    start = min(t["t"][0] for t in tables.values())
    names = sorted({c for t in tables.values() for c in t})
    columns = {
        c: np.concatenate([t.get(c, np.full(len(t["t"]), np.nan)) for t in tables.values()])
        for c in names
    }
    columns["t"] = columns["t"] - start
    vehicle = np.concatenate([np.full(len(t["t"]), v) for v, t in tables.items()])
    return LogTable(name, columns, vehicle, tuple(remarks))


IMPORTER = Importer("ROS 2 bag", is_bag, read_bag)

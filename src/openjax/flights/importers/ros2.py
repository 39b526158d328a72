"""Bags of ROS 2 (SQLite or MCAP) and ROS 1, through the `rosbags` library; no ROS
installation is needed.

Without a column mapping, topics are recognised by their message types, and a topic's
namespace ("/cf1" of "/cf1/imu") is the vehicle. Times are the messages' header stamps
where they have one, else the bag's receive times.
"""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.importers.columns import EULER, ColumnMapping, Source
from openjax.flights.importers.crazyswarm import (
    DEFINITIONS,
    LOG_TYPE,
    POSE_FIELDS,
    POSES_TYPES,
    custom_topics,
    log_stream,
    pose_source,
    pose_streams,
    variables_of,
)
from openjax.flights.importers.firmware import firmware_columns
from openjax.flights.importers.importer import Importer
from openjax.flights.importers.streams import Stream, merge_streams
from openjax.flights.reading import CHANNEL_COLUMNS, LogError, LogTable

_POSITION = CHANNEL_COLUMNS["position"]
_QUATERNION = CHANNEL_COLUMNS["quaternion"]
_POSE = (*_POSITION, *_QUATERNION, *EULER)


def _pose(position: str, orientation: str) -> dict[str, str]:
    fields = {c: f"{position}.{c}" for c in _POSITION}
    return fields | {c: f"{orientation}.{c[1]}" for c in _QUATERNION}


_RATES = {f"w{a}": f"angular_velocity.{a}" for a in "xyz"}
_FORCE = {f"a{a}": f"linear_acceleration.{a}" for a in "xyz"}

# By suffix how a bag's file begins.
STORAGE = {".mcap": b"\x89MCAP0", ".db3": b"SQLite format 3", ".bag": b"#ROSBAG V2.0"}
ODOMETRY = "nav_msgs/msg/Odometry"
# Fields of the message types that say what they hold: column -> field. An odometry's twist is left
# out: it is in the body frame, and velocity can be derived from position. Its pose goes behind
# others: Crazyswarm2's with cflib has the firmware's legacy sign of pitch.
KNOWN_TYPES = {
    "sensor_msgs/msg/Imu": _RATES | _FORCE,
    "geometry_msgs/msg/PoseStamped": _pose("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose(
        "pose.pose.position", "pose.pose.orientation"
    ),
    "geometry_msgs/msg/TransformStamped": _pose("transform.translation", "transform.rotation"),
    ODOMETRY: _pose("pose.pose.position", "pose.pose.orientation"),
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
    """True if a path is a bag: a folder, with its `metadata.yaml` or without, or a single file."""
    return bool(_files_of(path))


def _files_of(path: Path) -> list[Path]:
    """The files for a bag's reader; nothing if a path is no bag."""
    if path.is_file():
        return [path] if _is_storage(path) else []
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path] if path.is_dir() else []
    files = sorted(path.iterdir())
    return files if files and all(map(_is_storage, files)) else []


def _is_storage(path: Path) -> bool:
    """True if a file holds messages of ROS, by its first bytes; an MCAP file of others may lie
    beside flights, too.
    """
    start = STORAGE.get(path.suffix)
    if start is None or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(64)
    has_profile = path.suffix != ".mcap" or any(p in head for p in (b"ros1", b"ros2"))
    return head.startswith(start) and has_profile


def read_bag(path: str | Path, mapping: ColumnMapping | None = None) -> LogTable:
    """Read a bag. With a mapping, sources are "TOPIC:FIELD"
    ("/cf1/imu:angular_velocity.x", "/m:data[0]").

    Raises LogError if the bag can't be read or holds nothing known, UserError without
    the rosbags library.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise UserError(
            f"{path}: reading ROS bags needs the rosbags library: pip install rosbags"
        ) from error
    path = Path(path)
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    try:
        with AnyReader(_files_of(path), default_typestore=store) as reader:
            vehicles, remarks = _vehicles(reader, mapping, path)
            start = 1e-9 * reader.start_time
    except LogError:
        raise
    except Exception as error:  # the library raises many kinds for a damaged bag; all mean the same
        raise LogError(
            f"ROS bag can't be read: {str(error).splitlines()[0] if str(error) else type(error)}"
        ) from error
    tables, remarks = _merge(vehicles, remarks, mapping)
    # the firmware's variables go before topics
    of_firmware = [stream for v in vehicles.values() for stream in v.log_streams]
    duty_cycles = any("motor.m1" in stream.values for stream in of_firmware)
    table = _join(path.name, tables, remarks)
    return replace(table, duty_cycles=duty_cycles, clock_start=start + table.clock_start)


@dataclass(eq=False)
class _Recording:
    """The content of a bag for one vehicle: streams of topics, for each of them its rank and the
    sources of columns that its type names, and streams of log variables on the firmware's clock,
    which is `ahead` s behind the bag's.
    """

    streams: list[Stream] = field(default_factory=list)
    sources: list[tuple[int, dict[str, Source]]] = field(default_factory=list)
    log_streams: list[Stream] = field(default_factory=list)
    ahead: list[float] = field(default_factory=list)

    def add(self, stream: Stream, columns: dict[str, Source], rank: int = 0) -> None:
        """One more topic. What a topic of a lower `rank`, or a faster one, holds goes before."""
        self.streams.append(stream)
        self.sources.append((rank, columns))

    def columns(self) -> tuple[dict[str, Source], list[str]]:
        """The source of each column, and remarks. Log variables are on the vehicle's own clock and
        go before topics, but for a pose that a topic has more than twice as often.
        """
        by_name, remarks = firmware_columns(self.log_streams)
        both = zip(self.sources, self.streams, strict=True)
        topics = [(rank, _period(stream), columns) for (rank, columns), stream in both]
        # what comes later replaces what came before: the fastest of the lowest rank goes last
        topics.sort(key=lambda topic: topic[:2], reverse=True)
        columns = {c: source for *_, of_stream in topics for c, source in of_stream.items()}
        poses = [topic for topic in topics if "x" in topic[2]]
        if "x" in by_name and poses:
            with_position = next(s for s in self.log_streams if by_name["x"].name in s.values)
            if 2 * poses[-1][1] < _period(with_position):
                by_name = {c: source for c, source in by_name.items() if c not in _POSE}
        if set(EULER) <= set(by_name):
            columns = {c: source for c, source in columns.items() if c not in _QUATERNION}
        return columns | by_name, remarks

    def all_streams(self) -> list[Stream]:
        """On one clock. The radio delays a message, never hastens it, so that the least
        that a stamp is ahead of its tick is what the clocks are apart.
        """
        ahead = min(self.ahead, default=0.0)
        streams = [Stream(stream.time + ahead, stream.values) for stream in self.log_streams]
        return [*streams, *self.streams]


def _vehicles(
    reader, mapping: ColumnMapping | None, path: Path
) -> tuple[dict[str, _Recording], list[str]]:
    """{vehicle: what the bag holds of it}, and remarks. With a mapping all is one vehicle's."""
    topics = _wanted_columns(reader.connections, mapping)
    files = custom_topics(path) if mapping is None else []
    vehicles: dict[str, _Recording] = {}
    remarks = []
    for connection in reader.connections:
        topic = connection.topic
        vehicle = "" if mapping is not None else topic.rpartition("/")[0]
        if topic in topics:
            recording = vehicles.setdefault(vehicle, _Recording())
            columns = {c: Source(f"{topic}:{f}") for c, f in topics[topic].items()}
            # Crazyswarm2 leaves the pitch of an odometry in the firmware's sense
            rank = int(connection.msgtype == ODOMETRY)
            recording.add(_stream(reader, connection, topics[topic]), columns, rank)
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
    if mapping is None:
        remarks += _add_captured(reader, vehicles)
    return vehicles, remarks


def _add_captured(reader, vehicles: dict[str, _Recording]) -> list[str]:
    """Give each vehicle its poses of motion capture; remarks on bodies of which nothing
    else was logged.
    """
    others = []
    for connection in reader.connections:
        if connection.msgtype not in POSES_TYPES:
            continue
        topic = connection.topic
        for name, stream in pose_streams(topic, _messages(reader, connection)).items():
            columns = {c: Source(pose_source(topic, name, c)) for c in POSE_FIELDS}
            if f"/{name}" in vehicles:
                vehicles[f"/{name}"].add(stream, columns)
            else:
                others.append(name)
    if not others:
        return []
    return [f"nothing but poses was logged of {', '.join(others)}: left out"]


def _merge(
    vehicles: dict[str, _Recording], remarks: list[str], mapping: ColumnMapping | None
) -> tuple[dict[str, dict], list[str]]:
    """The columns of each vehicle, and remarks on those that hold none. Raises LogError
    if none does.
    """
    tables = {}
    for vehicle, recording in vehicles.items():
        if mapping is not None:
            columns = {c: s for c, s in mapping.columns.items() if c not in ("t", "vehicle")}
        else:
            columns, more_remarks = recording.columns()
            remarks += more_remarks
        try:
            tables[vehicle.strip("/") or "0"] = merge_streams(recording.all_streams(), columns)
        except LogError as error:
            remarks.append(f"topics of {vehicle or '/'}: {error}")
    if not tables:
        raise LogError(
            "; ".join(remarks) or "holds no topic of a known type; name its topics in columns.toml"
        )
    return tables, remarks


def _wanted_columns(connections, mapping: ColumnMapping | None) -> dict[str, dict[str, str]]:
    """Topic -> {column: field} of what is to be read."""
    topics: dict[str, dict[str, str]] = {}
    if mapping is not None:
        for column, source in mapping.columns.items():
            topic, separator, field = source.name.partition(":")
            if separator and column not in ("t", "vehicle"):
                topics.setdefault(topic, {})[column] = field
        return topics
    for connection in connections:
        fields = KNOWN_TYPES.get(connection.msgtype)
        if connection.msgtype in _ARRAY_TYPES:
            last = connection.topic.rpartition("/")[2].lower()
            fields = next((f for word, f in _ARRAY_NAMES.items() if word in last), None)
        if fields is not None:
            topics[connection.topic] = fields
    return topics


def _stream(reader, connection, fields: dict[str, str]) -> Stream:
    """The wanted fields of one topic, named "TOPIC:FIELD"."""
    times = []
    rows = []
    for stamp, message in _messages(reader, connection):
        times.append(stamp)
        rows.append([_field(message, field, connection.topic) for field in fields.values()])
    values = np.asarray(rows, float).reshape(len(rows), len(fields))
    by_field = {
        f"{connection.topic}:{field}": column
        for field, column in zip(fields.values(), values.T, strict=True)
    }
    return Stream(np.asarray(times, float) * 1e-9, by_field)


def _period(stream: Stream) -> float:
    """s between a stream's samples."""
    return float(np.median(np.diff(np.sort(stream.time)))) if len(stream.time) > 1 else np.inf


def _messages(reader, connection):
    """(stamp, message) of a topic: integer nanoseconds since the bag's start, which keep their
    resolution as floats of seconds; the header's where there is one, else when it was received.
    """
    for _, arrival, data in reader.messages(connections=[connection]):
        message = reader.deserialize(data, connection.msgtype)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        nanoseconds = 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec
        yield (nanoseconds or arrival) - reader.start_time, message


def _field(message, path: str, topic: str) -> float:
    try:
        for name, index in re.findall(r"(\w+)|\[(\d+)\]", path):
            message = message[int(index)] if index else getattr(message, name)
        return float(message)
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise LogError(f"messages of {topic} have no number {path!r}") from error


def _join(name: str, tables: dict[str, dict[str, np.ndarray]], remarks: list[str]) -> LogTable:
    """The vehicles' columns in the long format, time from the first row of any."""
    start = min(t["t"][0] for t in tables.values())
    names = sorted({c for t in tables.values() for c in t})
    columns = {
        c: np.concatenate([t.get(c, np.full(len(t["t"]), np.nan)) for t in tables.values()])
        for c in names
    }
    columns["t"] = columns["t"] - start
    vehicle = np.concatenate([np.full(len(t["t"]), v) for v, t in tables.items()])
    return LogTable(name, columns, vehicle, tuple(remarks), clock_start=float(start))


IMPORTER = Importer("ROS bag", is_bag, read_bag)

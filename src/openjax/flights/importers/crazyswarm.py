"""Topics of Crazyswarm2: log blocks of the firmware as `LogDataGeneric`, an array of
values, and the poses of all bodies that motion capture sees as one `NamedPoseArray`.

A log block's message doesn't say what its values are. The `crazyflies.yaml` with which
the server was started does, under `firmware_logging.custom_topics` of `all`, of a
robot's type, or of the robot; it is looked for beside the bag and in it.
"""

from pathlib import Path

import numpy as np

from openjax.flights.importers.firmware import with_mixer
from openjax.flights.importers.streams import Stream
from openjax.flights.reading import LogError

LOG_TYPE = "crazyflie_interfaces/msg/LogDataGeneric"
_CAPTURE = "motion_capture_tracking_interfaces/msg"
POSES_TYPES = (f"{_CAPTURE}/NamedPoseArray", f"{_CAPTURE}/NamedPoseArrayV2")
POSE_FIELDS = {f"{a}": f"position.{a}" for a in "xyz"} | {
    f"q{a}": f"orientation.{a}" for a in "wxyz"
}
# Of bags that don't hold them themselves (crazyswarm2's crazyflie_interfaces/msg, and
# motion_capture_tracking's), each after those that it is made of.
DEFINITIONS = {
    f"{_CAPTURE}/NamedPose": "string name\ngeometry_msgs/Pose pose\n",
    f"{_CAPTURE}/LatencyInfo": "string source\nuint32 latency\n",
    POSES_TYPES[0]: "std_msgs/Header header\nNamedPose[] poses\n",
    POSES_TYPES[1]: (
        "std_msgs/Header header\nuint64 timestamp\nLatencyInfo[] latencies\nNamedPose[] poses\n"
    ),
    LOG_TYPE: "std_msgs/Header header\nuint32 timestamp\nfloat32[] values\n",
    "crazyflie_interfaces/msg/Status": (
        "std_msgs/Header header\nuint16 supervisor_info\nfloat32 battery_voltage\nuint8 pm_state\n"
        "uint8 rssi\nuint32 num_rx_broadcast\nuint32 num_tx_broadcast\nuint32 num_rx_unicast\n"
        "uint32 num_tx_unicast\nuint16 latency_unicast\n"
    ),
}
LARGEST_YAML = 1 << 20  # bytes


def custom_topics(bag: Path) -> list[dict]:
    """The custom topics of the yaml files beside a bag and in it. One that can't be read says
    nothing: a case's folder may hold any.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    topics = []
    for path in sorted(
        p for folder in (bag, bag.parent) if folder.is_dir() for p in folder.glob("*.y*ml")
    ):
        if not path.is_file() or path.stat().st_size > LARGEST_YAML:
            continue
        try:
            tables = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        except (YAMLError, UnicodeDecodeError, OSError):
            continue
        if isinstance(tables, dict) and any(k in tables for k in ("all", "robots", "robot_types")):
            topics.append(tables)
    return topics


def variables_of(topic: str, files: list[dict]) -> tuple[str, ...] | None:
    """The log variables of a topic ("/cf1/state"), in their order; None where no file names it."""
    vehicle, _, name = topic.strip("/").rpartition("/")
    for tables in files:
        robot = _table(tables, "robots", vehicle)
        kind = robot.get("type")
        for owner in (robot, _table(tables, "robot_types", kind), _table(tables, "all")):
            variables = _table(owner, "firmware_logging", "custom_topics", name).get("vars")
            if isinstance(variables, list):
                return tuple(str(variable) for variable in variables)
    return None


def _table(tables, *keys) -> dict:
    """The table under some keys; an empty one where there is none."""
    for key in keys:
        tables = tables.get(key) if isinstance(tables, dict) else None
    return tables if isinstance(tables, dict) else {}


def log_stream(topic: str, variables: tuple[str, ...], messages) -> tuple[Stream, float]:
    """A topic's messages [(stamp in ns, message)] as a stream of log variables at the
    firmware's ticks, which don't wait for the radio, and by how much stamps are ahead
    of ticks at least (s). Raises LogError where messages hold another number of values.
    """
    counts = {len(message.values) for _, message in messages}
    if counts - {len(variables)}:
        raise LogError(
            f"messages of {topic} hold {', '.join(map(str, sorted(counts)))} values, but "
            f"crazyflies.yaml names {len(variables)}: {', '.join(variables)}"
        )
    values = np.array([message.values for _, message in messages], float)
    ticks = np.array([message.timestamp for _, message in messages], float) * 1e-3
    ahead = float(np.min(np.array([stamp for stamp, _ in messages], float) * 1e-9 - ticks))
    by_variable = dict(zip(variables, values.T, strict=True))
    return with_mixer(Stream(ticks, by_variable)), ahead


def pose_streams(topic: str, messages) -> dict[str, Stream]:
    """{body's name: stream of its poses}, named "TOPIC:NAME:x" and so on, of a topic's
    messages [(stamp in ns, message)]. A body that isn't seen is missing in a message,
    and one without an attitude has NaN there.
    """
    by_body: dict[str, list] = {}
    for stamp, message in messages:
        for body in message.poses:
            row = [stamp * 1e-9]
            for path in POSE_FIELDS.values():
                part, _, axis = path.partition(".")
                row.append(getattr(getattr(body.pose, part), axis))
            by_body.setdefault(body.name, []).append(row)
    streams = {}
    for name, rows in by_body.items():
        time, *values = np.array(rows, float).T
        columns = {pose_source(topic, name, c): v for c, v in zip(POSE_FIELDS, values, strict=True)}
        streams[name] = Stream(time, columns)
    return streams


def pose_source(topic: str, name: str, column: str) -> str:
    """The name of a column of a body's pose among a bag's sources."""
    return f"{topic}:{name}:{column}"

"""MCAP files that Foxglove opens: poses, scenes and numbers in its well-known schemas,
as JSON.

Schemas are those of github.com/foxglove/foxglove-sdk (foxglove.PoseInFrame,
foxglove.SceneUpdate), which Foxglove knows by their names; numbers are in one of our
own, to be plotted. Needs the `mcap` library.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.files import replacing
from openjax.show.trajectory import Trajectory

WORLD = "world"
LONGEST_STEP = 0.02  # s between poses of a replay: what a screen shows
RADIUS = 0.05  # m of the sphere that stands for a drone
PILLAR = {"r": 0.55, "g": 0.55, "b": 0.6, "a": 0.8}
PURSUER = {"r": 0.15, "g": 0.45, "b": 0.8, "a": 1.0}
EVADER = {"r": 0.85, "g": 0.3, "b": 0.2, "a": 1.0}

_VECTOR = {"type": "object", "properties": {a: {"type": "number"} for a in "xyz"}}
_QUATERNION = {"type": "object", "properties": {a: {"type": "number"} for a in "xyzw"}}
_POSE = {"type": "object", "properties": {"position": _VECTOR, "orientation": _QUATERNION}}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
SCHEMAS = {
    "foxglove.PoseInFrame": {"timestamp": _TIME, "frame_id": {"type": "string"}, "pose": _POSE},
    "foxglove.SceneUpdate": {
        "deletions": {"type": "array", "items": {"type": "object"}},
        "entities": {"type": "array", "items": {"type": "object"}},
    },
    "openjax.LogRow": {},
}
"""{name: properties} of what is written."""


@dataclass(frozen=True)
class Topic:
    """A topic: its name, its schema, and (time in s, message without time stamp)."""

    topic: str
    schema: str
    messages: Sequence[tuple[float, dict]]


def write_mcap(path: Path, channels: Iterable[Topic]) -> None:
    """Write channels, or nothing. Raises UserError without the library."""
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise UserError(f"{path}: writing MCAP needs the mcap library: pip install mcap") from error
    with replacing(path) as partial, partial.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="openjax")
        for channel in channels:
            schema = {"type": "object", "properties": SCHEMAS[channel.schema]}
            data = json.dumps({"title": channel.schema} | schema).encode()
            schema_id = writer.register_schema(channel.schema, "jsonschema", data)
            number = writer.register_channel(channel.topic, "json", schema_id)
            for time, message in channel.messages:
                stamp = round(1e9 * time)
                text = json.dumps(_stamp(channel.schema, message, stamp), allow_nan=False)
                writer.add_message(number, stamp, text.encode(), stamp)
        writer.finish()


def _stamp(schema: str, message: dict, stamp: int) -> dict:
    """A message with the time stamps that its schema wants."""
    time = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
    if schema == "foxglove.SceneUpdate":
        entities = [{"timestamp": time} | entity for entity in message["entities"]]
        return {"deletions": [], "entities": entities}
    return message if schema == "openjax.LogRow" else {"timestamp": time} | message


def pose(position, quaternion=(1.0, 0.0, 0.0, 0.0)) -> dict:
    """A pose of a position (3,) m and an attitude (4,) wxyz in Foxglove's words."""
    w, *xyz = (float(v) for v in quaternion)
    return {
        "position": dict(zip("xyz", (float(v) for v in position), strict=True)),
        "orientation": dict(zip("xyz", xyz, strict=True)) | {"w": w},
    }


def pose_channel(topic: str, time, position, quaternion=None) -> Topic:
    """The poses of one vehicle: times (T,) s, positions (T, 3) m, attitudes (T, 4) wxyz
    or None; rows that weren't sampled are left out.
    """
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1)) if quaternion is None else quaternion
    # JSON has no NaN
    rows = np.flatnonzero(np.isfinite(position).all(1) & np.isfinite(attitude).all(1))
    messages = [
        (float(time[k]), {"frame_id": WORLD, "pose": pose(position[k], attitude[k])}) for k in rows
    ]
    return Topic(topic, "foxglove.PoseInFrame", messages)


def trajectory_channels(name: str, flight: Trajectory) -> list[Topic]:
    """An episode: a pose for each drone, and a scene with drones and pillars. `name`
    begins the topics.
    """
    every = max(1, round(LONGEST_STEP / flight.time_step))
    # two seconds beyond the capture, so that one sees what came of it
    steps = np.arange(0, flight.end(seconds=2.0), every)
    time = steps * flight.time_step
    drones = {
        f"pursuer_{k + 1}": (flight.pursuer_position[steps, k], flight.pursuer_quaternion[steps, k])
        for k in range(flight.pursuer_position.shape[1])
    }
    drones["evader"] = (flight.evader_position[steps], None)
    poses = [
        pose_channel(f"/{name}/{drone}/pose", time, position, quaternion)
        for drone, (position, quaternion) in drones.items()
    ]
    scenes = []
    for row, moment in enumerate(time):
        entities = []
        for drone, (position, _) in drones.items():
            colour = EVADER if drone == "evader" else PURSUER
            entities.append(_entity(drone, "spheres", position[row], 2 * RADIUS, colour))
        scenes.append((float(moment), {"entities": entities}))
    if len(scenes):
        # in the first scene only: what stands stays
        scenes[0][1]["entities"] += _pillars(flight)
    return [*poses, Topic(f"/{name}/scene", "foxglove.SceneUpdate", scenes)]


def _entity(name: str, kind: str, position, size, colour: dict) -> dict:
    """One body of a scene, which stays until the same name comes again."""
    extent = np.broadcast_to(np.asarray(size, float), 3).tolist()
    body = {"pose": pose(position), "size": dict(zip("xyz", extent, strict=True)), "color": colour}
    if kind == "cylinders":
        body |= {"bottom_scale": 1.0, "top_scale": 1.0}
    lifetime = {"sec": 0, "nsec": 0}  # for ever
    return {
        "frame_id": WORLD,
        "id": name,
        "lifetime": lifetime,
        "frame_locked": False,
        kind: [body],
    }


def _pillars(flight: Trajectory) -> list[dict]:
    height = flight.arena_height
    diameter = 2 * flight.pillar_radius
    return [
        _entity(
            f"pillar_{k + 1}", "cylinders", (*at, height / 2), (diameter, diameter, height), PILLAR
        )
        for k, at in enumerate(np.asarray(flight.pillar_position, float))
    ]

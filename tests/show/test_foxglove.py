"""MCAP files hold what was flown, under names that Foxglove knows."""

import json

import numpy as np
import pytest

from openjax.commands.view import ViewCommand, write_flights
from openjax.errors import UserError
from openjax.show.foxglove import trajectory_channels, write_mcap
from openjax.show.trajectory import Trajectory


def messages(path):
    """{topic: [(schema, time in s, message)]} of an MCAP file."""
    reader = pytest.importorskip("mcap.reader")
    found = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            json.loads(schema.data)
            row = (schema.name, message.log_time * 1e-9, json.loads(message.data))
            found.setdefault(channel.topic, []).append(row)
    return found


def test_an_episode_is_read_back(tmp_path):
    pytest.importorskip("mcap")
    steps = 100
    rng = np.random.default_rng(1)
    quaternion = rng.standard_normal((steps, 2, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    flight = Trajectory(
        title="wall",
        pursuer_position=rng.standard_normal((steps, 2, 3)),
        pursuer_quaternion=quaternion,
        evader_position=rng.standard_normal((steps, 3)),
        captured=np.zeros((steps, 2), bool),
        crashed=np.zeros((steps, 2), bool),
        pillar_position=np.array([[0.1, 0.2], [0.3, -0.4]]),
        arena_radius=0.9,
        arena_height=1.2,
        pillar_radius=0.1,
        capture_radius=0.3,
        time_step=0.01,
    )
    write_mcap(tmp_path / "replay.mcap", trajectory_channels("open/wall", flight))
    found = messages(tmp_path / "replay.mcap")
    topics = {f"/open/wall/{d}/pose" for d in ("pursuer_1", "pursuer_2", "evader")}
    assert set(found) == topics | {"/open/wall/scene"}
    kind, time, last = found["/open/wall/pursuer_2/pose"][-1]
    assert kind == "foxglove.PoseInFrame" and time == pytest.approx(0.98)
    assert last["timestamp"] == {"sec": 0, "nsec": 980_000_000}
    for axis, value in zip("xyz", flight.pursuer_position[98, 1], strict=True):
        assert last["pose"]["position"][axis] == pytest.approx(value)
    for axis, value in zip("wxyz", quaternion[98, 1], strict=True):
        assert last["pose"]["orientation"][axis] == pytest.approx(value)
    kind, _, scene = found["/open/wall/scene"][0]
    assert kind == "foxglove.SceneUpdate"
    assert sum("cylinders" in entity for entity in scene["entities"]) == 2
    assert sum("spheres" in entity for entity in scene["entities"]) == 3


def test_the_flights_of_a_case_are_read_back(tmp_path, case_folder, sample_columns):
    pytest.importorskip("mcap")
    with pytest.raises(UserError, match="--mcap FILE"):
        write_flights(ViewCommand(flights=case_folder))
    write_flights(ViewCommand(flights=case_folder, mcap=tmp_path / "case.mcap"))
    found = messages(tmp_path / "case.mcap")
    assert {f"/flight_{name}/0/{kind}" for name in "abc" for kind in ("log", "pose")} == set(found)
    columns = sample_columns["flight_b"]
    rows = found["/flight_b/0/log"]
    assert len(rows) == len(columns["t"])
    np.testing.assert_allclose([r["m2"] for _, _, r in rows], columns["m2"], atol=1e-5)
    assert sum("vbat" in r for _, _, r in rows) == np.isfinite(columns["vbat"]).sum()

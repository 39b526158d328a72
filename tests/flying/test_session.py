"""Real processes, a real terminal, real cflib: whatever is killed, stopped or typed,
true vehicles come down and are disarmed.
"""

import sys
import threading
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("cflib", reason='the extra "fly" is not installed')

from openjax.commands.fly import FlyCommand, Prepared
from openjax.files import read_json
from openjax.flights.csv_table import read_csv
from openjax.flying.controller import nominal_airframe
from openjax.flying.game import Play
from openjax.flying.loop import flight_state
from openjax.flying.session import SessionSettings
from openjax.flying.state import SafetySettings
from openjax.vehicle.vehicle_file import load_vehicle_file
from tests.flying.fault_injection.processes import Flown
from tests.flying.fault_injection.virtual import VirtualProcess

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]


class Level:
    """A game whose policy hovers."""

    airframe = nominal_airframe()

    def __init__(self, starts):
        import numpy as np

        self._nothing, self._action = (
            np.zeros(3),
            np.array([[2 * self.airframe.hover_thrust - 1, 0, 0, 0]] * 3),
        )
        self.task = SimpleNamespace(
            pursuer_position=np.array(starts), evader_position=np.array([-0.5, 0.0, 0.5]),
            pillar_position=np.zeros((1, 2)), pillar_active=np.zeros(1, bool),
        )  # fmt: skip
        self.settings = SimpleNamespace(num_pursuers=3, pillar_radius=0.1, max_speed=1.0)

    def start(self, poses):
        return self.step(poses)

    def step(self, poses, evader=None):
        # angles don't come from rates that are zero: level by what is seen
        action = self._action.copy()
        action[:, 1:3] = [[-2.0 * p.quaternion[1], -2.0 * p.quaternion[2]] for p in poses]
        nothing = self._nothing
        return Play(action, nothing, nothing, False, False, nothing, nothing.astype(bool))


@pytest.fixture(scope="module")
def flying():
    virtual = VirtualProcess("wall")
    starts = [(*pose.position[:2], 0.5) for pose in virtual.truth.poses()]
    game = Level(starts)
    uris = tuple(virtual.uris)
    state = flight_state(game, 3, SafetySettings())
    prepared = Prepared(
        game,
        state,
        SessionSettings(uris),
        load_vehicle_file(),
        {"policy": "level", "scenario": "wall", "uris": uris},
    )
    yield lambda number, kind, out=None: Flown(
        number, kind, virtual, FlyCommand(uri=uris, episode_seconds=8.0, out=out), prepared
    ).fly()
    virtual.close()


@pytest.mark.parametrize(
    "kind",
    [
        "KILL loop", "STOP loop", "KILL links", "STOP guard", "KILL loop+links", "KILL loop+guard", "KILL links+guard",
        "KILL links then guard", "KILL links then space", "KILL links+guard then space", "STOP links+guard",
        "STOP loop then CONT", "STOP guard then CONT", "drone restarts", "camera restarts", "policy fails",
        "TERM links", "TERM group", "HUP loop", "terminal closed", "Ctrl-Z", "Ctrl-C three times", "l and space",
        "camera frozen", "camera: yaw turned", "camera drifts", "gyroscope: a number that is none", "start: millimetres",
        "KILL guard", "policy: a number that is none", "policy alternating", "camera late", "strangers' packets", "second fly",
    ],
)  # fmt: skip
def test_whatever_happens_all_are_down_inside_and_disarmed(flying, kind):
    record = flying(7, kind)
    assert record["well"], str(record)
    assert kind != "KILL guard" or "the guard is gone" in record["said"]
    assert kind != "Ctrl-C three times" or "pose lost" not in record["said"], "it landed blindly"


@pytest.mark.parametrize(
    "kind",
    ["terminal closed", "KILL loop", "KILL links", "TERM loop", "KILL loop+links", "STOP loop"],
)
def test_a_flight_that_goes_wrong_leaves_a_log(flying, tmp_path, kind):
    """Of all that was flown, in a form that the diagnosis reads."""
    log = tmp_path / "log"
    record = flying(7, kind, log)
    assert record["well"], str(record)
    deadline = time.monotonic() + 30.0
    while "reasons" not in read_json(log / "flight.json") and time.monotonic() < deadline:
        time.sleep(0.1)
    (game,) = read_json(log / "flight.json")["games"]
    times = read_csv(log / "game_00.csv.gz").columns["t"]
    assert times[-1] > 0.01 * game["steps"] - 0.05
    assert (log / "vehicle.toml").exists()


def test_a_log_that_cant_be_written_is_somewhere_else(flying, tmp_path, monkeypatch):
    """Its folder was there before the flight, and is a file during it."""
    (tmp_path / "second").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "second"))
    threading.Timer(1.0, (tmp_path / "folder").touch).start()
    record = flying(7, "key l", tmp_path / "folder" / "log")
    assert record["well"] and record["status"] == 2, str(record)
    assert "Traceback" not in record["said"] and "the log is in" in record["said"]
    assert list((tmp_path / "second").glob("*/game_00.csv.gz"))

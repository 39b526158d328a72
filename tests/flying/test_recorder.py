"""What is left of a flight, whatever becomes of its processes and its disk."""

import json
import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.errors import UserError
from openjax.files import check_room
from openjax.flights.csv_table import read_csv
from openjax.flying.flight_files import CaseFolder, GameLog, VehicleSamples
from openjax.flying.flight_record import FlightRecord
from openjax.flying.record_pipe import RecordKind, Teller
from openjax.flying.recorder import NewCase, Recorder
from openjax.flying.set_point import RATES, SetPoint

KILLED = """
import os, signal, sys, time
from pathlib import Path
from openjax.flying.flight_record import FlightRecord
from openjax.flying.recorder import NewCase, Recorder
from openjax.flying.flight_record import FlightRecord
from openjax.flying.record_pipe import RecordKind, Teller
from openjax.flying.set_point import SetPoint, RATES

if __name__ == "__main__":
    recorder = Recorder(NewCase(Path(sys.argv[1]), {"vehicle.toml": b""}, {"policy": "none"}), 1)
    links = Teller(os.fdopen(os.dup(recorder.links_pipe.fileno()), "wb"))
    record = FlightRecord(1, recorder.tell_tick, recorder.tell_game)
    recorder.start()
    recorder.begin("")
    record.begin_game()
    for k in range(100 * int(sys.argv[2])):
        time.sleep(.01)
        if k in (30, 130):  # for a second it gets no turn
            os.kill(recorder._process.pid, signal.SIGSTOP if k == 30 else signal.SIGCONT)
        now = time.perf_counter()
        links.row(RecordKind.POSES, 0, (now, 4.0, now, *range(13)))
        record.keep((now, now, 0), [now], [now], [SetPoint(RATES, thrust=.5)])
    print(k, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def samples_of(seconds):
    times = np.arange(0.0, seconds, 0.01)
    poses = np.column_stack(
        [times, 4.0 + 0 * times, times, np.sin(np.outer(times, np.arange(1, 14)))]
    )
    bodies = np.column_stack([times + 0.002, np.cos(np.outer(times, np.arange(1, 11)))])
    return VehicleSamples(poses, bodies, np.zeros((0, 14)))


def whole(tmp_path, cuts):
    """The log of one game of two vehicles, written in pieces up to `cuts` (s)."""
    sent_at = np.arange(0.5, 1.5, 0.01)
    commands = np.zeros((len(sent_at), 2, 5))
    commands[..., 0] = RATES
    commands[..., 1] = np.sin(sent_at)[:, None]
    log = GameLog(0)
    samples = [samples_of(2.0), samples_of(1.4)]
    return b"".join(log.piece(samples, sent_at, commands, until) for until in (*cuts, np.inf))


@settings(max_examples=10)
@given(st.lists(st.floats(0.0, 2.0), max_size=6).map(sorted))
def test_a_log_in_pieces_is_the_log_in_one(tmp_path_factory, cuts):
    folder = tmp_path_factory.mktemp("log")
    tables = []
    for name, when in (("pieces", cuts), ("one", ())):
        path = folder / f"{name}.csv.gz"
        path.write_bytes(whole(folder, when))
        tables.append(read_csv(path))
    pieces, one = tables
    assert pieces.columns.keys() == one.columns.keys()
    assert (pieces.vehicle == one.vehicle).all()
    for name, column in one.columns.items():
        np.testing.assert_array_equal(pieces.columns[name], column)


def test_who_tells_never_waits_for_a_recorder_that_is_stuck():
    reader, writer = os.pipe()
    teller = Teller(os.fdopen(writer, "wb"))
    row = tuple(float(k) for k in range(16))
    for _ in range(10_000):  # some megabytes: no pipe holds as much
        teller.row(RecordKind.POSES, 0, row)
    os.set_blocking(reader, False)
    got = b""
    while len(got) < 10_000 * (12 + 128):
        teller.tell(RecordKind.END, 0, b"")  # goes on with what was left
        got += os.read(reader, 1 << 20)
    assert got.count(np.array(row).tobytes()) == 10_000


def test_a_full_disk_leaves_whole_pieces(tmp_path, monkeypatch):
    """A limit on a file's size stands for the disk's end, in all places."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "second"))
    (tmp_path / "second").mkdir()
    case = CaseFolder(tmp_path / "first")
    case.put("vehicle.toml", b"# a vehicle")
    case.extend("game_00.csv.gz", b"a" * 600)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        case.extend("game_00.csv.gz", b"b" * 600)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    case.put("flight.json", b"{}")
    assert not case.complete and str(case.folder) in case.refusal
    assert (tmp_path / "first" / "game_00.csv.gz").read_bytes() == b"a" * 600
    assert (tmp_path / "first" / "flight.json").exists()
    assert not list((tmp_path / "second").iterdir())


def test_a_place_that_is_lost_is_left_for_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "second"))
    (tmp_path / "second").mkdir()
    (tmp_path / "file").touch()
    case = CaseFolder(tmp_path / "file" / "log")
    case.put("flight.json", b"{}")
    assert case.folder.parent == tmp_path / "second" and (case.folder / "flight.json").exists()
    assert str(tmp_path / "file") in case.refusal


def test_room_is_looked_for_before_the_take_off(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    check_room(tmp_path / "new" / "log", 1000, "--out")
    with pytest.raises(UserError, match="MB are needed"):
        check_room(tmp_path, 1 << 60, "--out")
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(UserError, match="no room"):
            check_room(tmp_path, 100_000, "--out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_a_loop_that_is_killed_leaves_its_log(tmp_path):
    """The whole of it, whenever the recorder had its turns."""
    script = tmp_path / "fly.py"
    script.write_text(KILLED)
    process = subprocess.run(
        [sys.executable, script, tmp_path / "log", "3"], stdout=subprocess.PIPE, text=True
    )
    assert process.returncode == -signal.SIGKILL
    about = {}
    deadline = time.monotonic() + 60.0
    while "reasons" not in about and time.monotonic() < deadline:
        time.sleep(0.1)
        if (tmp_path / "log" / "flight.json").exists():
            about = json.loads((tmp_path / "log" / "flight.json").read_text())
    assert "loop" in about["reasons"][0] and about["timing"]["ticks"] == int(process.stdout) + 1
    table = read_csv(tmp_path / "log" / "game_00.csv.gz")
    assert len(table.columns["t"]) >= int(process.stdout) - 1
    assert (
        np.ptp(table.columns["cmd_thrust"]) == 0.0 and (tmp_path / "log" / "vehicle.toml").exists()
    )


def test_a_flight_that_never_begins_leaves_nothing(tmp_path):
    recorder = Recorder(NewCase(tmp_path / "log", {"vehicle.toml": b""}, {}), 1)
    recorder.start()
    try:
        assert recorder.end([""]).folder is None
    finally:
        recorder.close()
    assert not (tmp_path / "log").exists()


def test_links_that_are_killed_keep_nobody_waiting(tmp_path):
    """The loop flies on without them: nothing more is to come from links that are gone."""
    recorder = Recorder(NewCase(tmp_path / "log", {"vehicle.toml": b""}, {}), 1)
    links = Teller(os.fdopen(os.dup(recorder.links_pipe.fileno()), "wb"))
    record = FlightRecord(1, recorder.tell_tick, recorder.tell_game)
    recorder.start()
    try:
        recorder.begin("")
        record.begin_game()
        links.row(RecordKind.POSES, 0, (0.0, 4.0, 0.0, *range(13)))
        del links
        for now in np.arange(1, 300) * 0.01:
            record.keep((now, now, 0), [now], [now], [SetPoint(RATES, thrust=0.5)])
        outcome = recorder.end(["the links' process is gone"])
        assert not outcome.complaint and outcome.folder == tmp_path / "log"
    finally:
        recorder.close()
    assert json.loads((tmp_path / "log" / "flight.json").read_text())["games"]

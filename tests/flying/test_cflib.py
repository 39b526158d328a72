"""With the real cflib over loopback: its packets mean what we mean, a flight from
take-off to its log, the guard.
"""

import multiprocessing
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cflib", reason='the extra "fly" is not installed')

from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.errors import UserError
from openjax.flying.board import Board, Role
from openjax.flying.controller import nominal_airframe
from openjax.flying.course import FlightPlan
from openjax.flying.crtp import Supervisor
from openjax.flying.estimation import see
from openjax.flying.flight_record import FlightRecord
from openjax.flying.game import Play
from openjax.flying.links import Links
from openjax.flying.loop import FlightLoop, flight_state
from openjax.flying.motion_capture import MotionCaptured
from openjax.flying.raw_links import RawLinks
from openjax.flying.recorder import NewCase, Recorder
from openjax.flying.set_point import (
    ANGLES,
    LEAST_THRUST,
    MOST_THRUST,
    RATES,
    SetPoint,
    as_sent,
    manual_arguments,
)
from openjax.flying.state import Mode, SafetySettings, initial_state
from openjax.flying.takeover import fly_down
from openjax.vehicle import load_vehicle
from openjax.vehicle.vehicle_file import load_vehicle_file, save_vehicle_file
from openjax.virtual_crazyflie.firmware import VirtualFirmware
from openjax.virtual_crazyflie.link import LinkFaults
from openjax.virtual_crazyflie.process import VirtualCrazyflies
from openjax.virtual_crazyflie.vehicles import VirtualVehicles

PATIENT = SafetySettings(pose_timeout=2.0, link_timeout=3.0, action_timeout=2.0)
"""A busy machine is no reason to land."""

angles = st.floats(-3.0, 3.0)


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from([RATES, ANGLES]), angles, angles, angles, st.floats(LEAST_THRUST, MOST_THRUST)
)
def test_a_set_point_arrives_on_board_as_it_was_meant(mode, roll, pitch, yaw_rate, thrust):
    from cflib.crazyflie.commander import Commander

    firmware = VirtualFirmware(needs_arming=False)

    def send(packet):
        firmware.receive(bytes([packet.get_header()]) + bytes(packet.data), 0.0)

    wanted = SetPoint(mode, roll, pitch, yaw_rate, thrust)
    Commander(SimpleNamespace(send_packet=send)).send_setpoint_manual(*manual_arguments(wanted))
    got = firmware.set_point(0.0)
    assert got.mode == wanted.mode
    np.testing.assert_allclose(got[1:4], wanted[1:4], atol=1e-5)
    assert abs(got.thrust - as_sent(wanted).thrust) < 3e-5


@contextmanager
def virtual(*options):
    """Three virtual Crazyflies, by the command that a user gives; their URIs."""
    command = [sys.executable, "-m", "openjax", "virtual_crazyflie", "--port", "0", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process.stdout.readline().split("--uri ")[1].split()
    finally:
        process.terminate()
        process.wait()


@pytest.fixture(scope="module")
def uris():
    with virtual() as found:
        yield found


@contextmanager
def connected(uris, body_logs, kind=Links, log=None):
    """Links that know all poses."""
    links = kind(uris, body_logs, silence=1.0)  # a busy machine
    links.connect(log=log)
    try:
        while any(s.own is None for s in links.observe()):
            links.wait(time.perf_counter() + 0.02)
        yield links
    finally:
        links.close()


class Hovering:
    """A game whose policy hovers: what the loop needs of a game."""

    airframe = nominal_airframe()

    def __init__(self, links):
        starts = np.array([(*s.own.position[:2], 0.4) for s in links.observe()])
        self.task = SimpleNamespace(
            pursuer_position=starts,
            evader_position=np.array([-0.5, 0.0, 0.5]),
            pillar_position=np.zeros((1, 2)),
            pillar_active=np.zeros(1, bool),
        )
        self.settings = SimpleNamespace(num_pursuers=3, pillar_radius=0.1, max_speed=1.0)
        self.steps = 0

    def start(self, poses):
        return self._play(poses)

    def step(self, poses, evader=None):
        self.steps += 1
        return self._play(poses)

    def _play(self, poses):
        # hover, level out, and wobble: a log in which nothing changes is refused
        wobble = 0.05 * np.sin(0.3 * self.steps + np.arange(3))
        action = [
            [
                0.2492 + wobble[2],
                wobble[0] - p.quaternion[1],
                wobble[1] - p.quaternion[2],
                wobble[2],
            ]
            for p in poses
        ]
        nothing = np.zeros(3)
        captured = self.steps > 10
        return Play(
            np.array(action), nothing, nothing, captured, False, nothing, nothing.astype(bool)
        )


def flight_of(links, seconds, **more):
    game = Hovering(links)
    state = flight_state(game, 3, PATIENT)
    return FlightLoop(links, game, state, FlightPlan(episode_seconds=seconds), **more)


def fly_hovering(uris, folder, body_logs, seconds):
    """A short flight: the flight, and the case as the diagnosis reads it."""
    from openjax.flights.case import load_case

    save_vehicle_file(folder / "vehicle.toml", load_vehicle_file())
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    recorder = Recorder(NewCase(folder / "case", files, {}), 3)
    record = FlightRecord(3, recorder.tell_tick, recorder.tell_game)
    with connected(uris, body_logs, log=recorder.links_pipe) as links:
        recorder.start()
        links.arm()
        recorder.begin("")
        flight = flight_of(links, seconds, record=record)
        flight.run()
        # the accelerometer comes up with the poses; down again it feels its weight
        for sample in links.observe():
            assert abs(sample.force[2] - 9.81) < 1.0
        outcome = recorder.end(["over"])
    recorder.close()
    assert outcome.folder == folder / "case" and not outcome.complaint
    return flight, load_case(outcome.folder)


@pytest.mark.slow
@pytest.mark.real_time
def test_a_flight_from_the_floor_to_its_log(uris, tmp_path):
    flight, case = fly_hovering(uris, tmp_path, body_logs=1, seconds=2.3)
    assert flight.state.all_in(Mode.LANDED)
    assert flight.record.games[0].capture_step == 11
    timing = flight.record.timing()
    assert timing["ticks"] > 200
    assert not any(d.own.fault for d in flight.state.drones)
    # a set-point leaves after the poses that it was made of, and those were measured
    # before they arrived
    assert 0.0 < timing["command_age_ms"]["p50"] < timing["measured_to_sent_ms"]["p50"] < 10.0
    assert {f.vehicle for f in case.flights} == {"0", "1", "2"}
    for flown in case.flights:
        assert flown.has_pose and flown.has_imu and flown.has_motors and flown.has_commands
        # what the motors were asked for follows the commanded thrust
        assert abs(np.nanmedian(flown.motor_command) - np.nanmedian(flown.command_thrust)) < 0.05
        assert abs(np.nanmedian(flown.specific_force[:, 2]) - 9.81) < 1.0


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize(("latency", "loss"), [(0.0, 0.0), (6.0, 0.0), (12.0, 0.1)])
def test_the_log_tells_the_links_latency_and_loss(tmp_path, latency, loss):
    """By the motors, whose mean is the thrust that was asked for as long as none of
    them is at its limit.
    """
    with virtual("--latency_ms", str(latency), "--loss", str(loss)) as uris:
        _, case = fly_hovering(uris, tmp_path, body_logs=5, seconds=4.0)
    delays = []
    sent = 0
    arrived = 0
    for flown in case.flights:
        motors = flown.motor_command.mean(1)
        logged = np.isfinite(motors) & (flown.motor_command.max(1) < 0.999)
        # The five blocks of motors aren't sampled together; on a busy machine two of
        # them may meet.
        phases = np.histogram(
            (1e3 * flown.time[np.isfinite(motors)]) % 10.0, bins=10, range=(0.0, 10.0)
        )[0]
        assert (phases > 0.1 * phases.max()).sum() >= 3
        changes = np.flatnonzero(np.diff(flown.command_thrust) != 0.0)[2:-6] + 1
        for change in changes:
            since = flown.time - flown.time[change]
            near = logged & (since > -0.005) & (since < latency * 1e-3 + 0.012)
            same = np.flatnonzero(near & (np.abs(motors - flown.command_thrust[change]) < 4e-5))
            sent += 1
            arrived += len(same) > 0
            delays += [1e3 * since[same[0]]] if len(same) else []
    assert sent > 150
    assert latency - 1.0 <= np.median(delays) < latency + 3.0
    assert abs(1.0 - arrived / sent - loss) < 0.04 + 0.6 / np.sqrt(
        sent
    )  # a busy machine, and the draw of few set-points


@pytest.mark.slow
@pytest.mark.real_time
def test_another_process_lands_and_disarms_what_hangs_in_the_air(uris):
    with connected(uris, body_logs=0) as links:
        links.arm()
        flight = flight_of(links, 60.0)
        deadline = time.monotonic() + 120.0
        while not flight.state.all_in(Mode.PURSUIT):
            assert time.monotonic() < deadline, [(d.mode, d.reason) for d in flight.state.drones]
            flight.tick(time.perf_counter(), time.perf_counter())
            time.sleep(0.008)
        assert min(s.own.position[2] for s in links.observe()) > 0.3
        board = Board(3, multiprocessing.get_context("spawn"))
        board.write(Role.LOOP, time.perf_counter(), flight.state)
        # the loop is silent from here on; the guard has links of its own
        own = RawLinks(uris, links.pose_blocks())
        own.open()
        try:
            last = fly_down(board, Role.GUARD, own, flight.state)
            samples = own.observe()
        finally:
            own.close()
        assert last.all_in(Mode.LANDED) and not board.flying
        assert not any(d.reason == "pose lost" for d in last.drones)
        assert not any(s.supervisor & Supervisor.ARMED for s in samples)
    with connected(uris, body_logs=0) as links:
        assert max(s.own.position[2] for s in links.observe()) < 0.05


@pytest.mark.slow
@pytest.mark.real_time
def test_a_broken_link_process_is_an_error_and_not_a_wait(uris):
    with connected(uris, body_logs=0) as links:
        next(p for p in multiprocessing.active_children() if p.name == "openjax links").kill()
        with pytest.raises(UserError, match="links' process"):
            for _ in range(3):
                links.send([SetPoint()] * 3)


@pytest.mark.slow
@pytest.mark.real_time
def test_motion_capture_is_seen_here_and_on_board():
    """The virtual Crazyflie in a thread of this process, so that its firmware can be
    looked into.
    """
    virtual = VirtualCrazyflies(
        VirtualVehicles(load_vehicle(), [(0.4, 0.0)]), port=0, faults=LinkFaults()
    )
    over = threading.Event()
    thread = threading.Thread(target=virtual.run, args=(over.is_set,), daemon=True)
    thread.start()
    firmware = virtual.firmware[0]
    try:
        with connected(virtual.uris, 0, MotionCaptured) as captured:
            state = initial_state([(0.4, 0.0, 0.5)], settings=PATIENT)
            for k in range(40):
                captured.update(
                    0, (0.3 + 0.005 * k, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), at=100.0 + 0.01 * k
                )
                (sample,) = captured.observe()
                state = see(state, 100.0 + 0.01 * k, (sample,))
                captured.believed(0, state.drones[0].captured.pose, feeds_estimator=True)
            assert captured.arrivals() == (100.0 + 0.01 * 39,)
            np.testing.assert_allclose(
                state.drones[0].estimate.velocity, (0.5, 0.0, 0.0), atol=1e-3
            )
            deadline = time.monotonic() + 60.0
            while firmware.external_poses < 40 and time.monotonic() < deadline:
                time.sleep(0.01)
            np.testing.assert_allclose(
                firmware.external_pose[:4], (0.495, 0.0, 0.5, 1.0), atol=1e-6
            )
    finally:
        over.set()
        thread.join()
        virtual.close()

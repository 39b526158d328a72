"""With the real cflib over loopback: its packets mean what we mean, a flight from take-off to its log, the guard."""

import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cflib", reason='the extra "fly" is not installed')

from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.flying.flight_files import write_case
from openjax.flying.guard import _EACH, _HEAD, _MODES, land
from openjax.flying.loop import Flight, Plan
from openjax.flying.motion_capture import MotionCaptured
from openjax.flying.safety import Mode, SafetySettings
from openjax.flying.set_point import (
    ANGLES,
    LEAST_THRUST,
    MOST_THRUST,
    RATES,
    SetPoint,
    as_sent,
    manual_arguments,
)
from openjax.flying.swarm import Swarm
from openjax.flying.virtual_firmware import VirtualFirmware
from openjax.flying.virtual_link import LinkFaults
from openjax.flying.virtual_process import VirtualCrazyflies
from openjax.flying.virtual_vehicles import VirtualVehicles
from openjax.vehicle import load_vehicle
from openjax.vehicle.vehicle_file import load_vehicle_file

PATIENT = SafetySettings(pose_timeout=2.0, link_timeout=3.0, action_timeout=2.0)
"""A busy machine is no reason to land."""

angles = st.floats(-3.0, 3.0)


@settings(max_examples=50, deadline=None)
@given(st.sampled_from([RATES, ANGLES]), angles, angles, angles, st.floats(LEAST_THRUST, MOST_THRUST))
def test_a_set_point_arrives_on_board_as_it_was_meant(mode, roll, pitch, yaw_rate, thrust):
    from cflib.crazyflie.commander import Commander

    firmware = VirtualFirmware(needs_arming=False)

    def send(packet):
        firmware.receive(bytes([packet.get_header()]) + bytes(packet.data), 0.0)

    wanted = SetPoint(mode, roll, pitch, yaw_rate, thrust)
    Commander(SimpleNamespace(send_packet=send)).send_setpoint_manual(*manual_arguments(wanted))
    got = firmware.set_point(0.0)
    assert got.mode == wanted.mode
    np.testing.assert_allclose(got.array()[1:4], wanted.array()[1:4], atol=1e-5)
    assert abs(got.thrust - as_sent(wanted).thrust) < 3e-5


@pytest.fixture(scope="module")
def vehicles():
    """Three virtual Crazyflies, flying in a thread of their own."""
    inside = VirtualVehicles(load_vehicle(), [(0.4, 0.0), (0.4, 0.3), (0.4, -0.3)])
    virtual = VirtualCrazyflies(inside, port=0, faults=LinkFaults())
    over = threading.Event()
    thread = threading.Thread(target=virtual.run, args=(over.is_set,), daemon=True)
    thread.start()
    yield virtual
    over.set()
    thread.join()
    virtual.close()


class Hovering:
    """A game whose policy hovers: what the loop needs of a game."""

    hover_thrust = 0.6246

    def __init__(self, vehicles):
        starts = np.concatenate([vehicles.vehicles.report.position[:, :2], np.full((3, 1), 0.4)], 1)
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
            [0.2492 + wobble[2], wobble[0] - p.quaternion[1], wobble[1] - p.quaternion[2], wobble[2]]
            for p in poses
        ]
        nothing = np.zeros(3)
        return SimpleNamespace(
            action=np.array(action), evader_position=nothing, evader_velocity=nothing, captured=self.steps > 10,
            over=False, breaches=nothing, crashed=nothing.astype(bool),
        )  # fmt: skip


def test_a_flight_from_the_floor_to_its_log(vehicles, tmp_path):
    swarm = Swarm(vehicles.uris, body_logs=1)
    swarm.connect()
    try:
        while any(s.pose is None for s in swarm.sightings()):
            time.sleep(0.01)
        swarm.arm()
        swarm.record()
        plan = Plan(episode_seconds=2.3)
        flight = Flight(swarm, Hovering(vehicles), PATIENT, plan)
        record = flight.run()
    finally:
        swarm.close()
    assert flight.state.all_in(Mode.LANDED)
    assert max(p.position[2] for _, p, _ in swarm.members[0].poses) > 0.3
    assert record.episodes[0]["capture_step"] == 11
    assert record.timing()["ticks"] > 200
    write_case(tmp_path, swarm.members, record, load_vehicle_file(), {})

    from openjax.flights.case import load_case

    case = load_case(tmp_path)
    assert {f.vehicle for f in case.flights} == {"0", "1", "2"}
    for flown in case.flights:
        assert flown.has_pose and flown.has_imu and flown.has_motors and flown.has_commands
        # what the motors were asked for follows the commanded thrust
        assert abs(np.nanmedian(flown.motor_command) - np.nanmedian(flown.command_thrust)) < 0.05
        assert abs(np.nanmedian(flown.specific_force[:, 2]) - 9.81) < 1.0


def test_the_guard_lands_what_hangs_in_the_air(vehicles):
    swarm = Swarm(vehicles.uris, body_logs=0)
    swarm.connect()
    while any(s.pose is None for s in swarm.sightings()):
        time.sleep(0.01)
    swarm.arm()
    flight = Flight(swarm, Hovering(vehicles), PATIENT, Plan(episode_seconds=60.0))
    deadline = time.monotonic() + 30.0
    while not flight.state.all_in(Mode.PURSUIT):
        assert time.monotonic() < deadline, flight.state
        flight.tick(time.perf_counter(), time.perf_counter())
        time.sleep(0.008)
    assert vehicles.vehicles.report.position[:, 2].min() > 0.3
    blocks, state = swarm.pose_blocks(), flight.state
    numbers = [time.perf_counter(), 1.0, 1.0]
    for drone in state.drones:
        e = drone.estimate
        numbers += [_MODES.index(drone.mode), drone.trim, 1.0]
        numbers += [*e.position, *e.velocity, *e.quaternion, *e.body_rates]
    assert len(numbers) == _HEAD + 3 * _EACH
    # the loop is silent from here on; the guard has links of its own
    import cflib.crtp

    links = [cflib.crtp.get_link_driver(uri, lambda *_: None, lambda *_: None) for uri in vehicles.uris]
    try:
        last = land(numbers, links, vehicles.uris, blocks, PATIENT, state)
    finally:
        for link in links:
            link.close()
        swarm.close()
    assert last.all_in(Mode.LANDED)
    time.sleep(1.0)
    assert vehicles.vehicles.report.position[:, 2].max() < 0.05
    assert not any(firmware.crashed for firmware in vehicles.firmware)


def test_motion_capture_is_seen_here_and_on_board(vehicles):
    swarm = Swarm(vehicles.uris[:1], body_logs=0)
    swarm.connect()
    try:
        captured = MotionCaptured(swarm)
        before = vehicles.firmware[0].external_poses
        for k in range(40):
            captured.update(0, (0.3 + 0.005 * k, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), at=100.0 + 0.01 * k)
        captured.update(0, (np.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), at=101.0)
        (sighting,) = captured.sightings()
        assert captured.arrivals() == (100.0 + 0.01 * 39,)
        np.testing.assert_allclose(sighting.pose.velocity, (0.5, 0.0, 0.0), atol=1e-3)
        deadline = time.monotonic() + 5.0
        while vehicles.firmware[0].external_poses < before + 40 and time.monotonic() < deadline:
            time.sleep(0.01)
        np.testing.assert_allclose(vehicles.firmware[0].external_pose[:4], (0.495, 0.0, 0.5, 1.0), atol=1e-6)
    finally:
        swarm.close()


FROZEN = """
import os, signal, sys, time
from openjax.flying.controller import Pose
from openjax.flying.guard import Guard
from openjax.flying.safety import Drone, Mode, SafetySettings, initial_state
from dataclasses import replace

if __name__ == "__main__":
    state = initial_state([(0.4, 0.0, 0.5)])
    flying = replace(state, drones=(Drone(Mode.PURSUIT, estimate=Pose(0.0, (0.4, 0.0, 0.0), (0.0,) * 3, (1.0, 0.0, 0.0, 0.0))),))
    guard = Guard([sys.argv[1]], [1], SafetySettings(), flying, after=0.2)
    assert guard.wait()
    guard(time.perf_counter(), flying)
    os.kill(os.getpid(), signal.SIGSTOP)
"""


def test_a_frozen_loop_is_ended_and_its_vehicle_taken_over(tmp_path):
    import socket

    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    listener.settimeout(20.0)
    script = tmp_path / "frozen.py"
    script.write_text(FROZEN)
    loop = subprocess.Popen([sys.executable, str(script), f"udp://127.0.0.1:{listener.getsockname()[1]}"])
    try:
        assert loop.wait(timeout=60) == -9
        packet = listener.recv(64)
        assert packet[0] >> 4 == 7  # a set-point by the guard
    finally:
        loop.kill()
        listener.close()

"""The vehicles inside virtual Crazyflies: what is logged together happened together."""

import math
import socket
import time

import numpy as np
import pytest

from openjax.flights.case import load_case
from openjax.flying.controller import nominal_airframe
from openjax.flying.crtp import compress_quaternion, expand_quaternion
from openjax.flying.flight_files import GameLog, VehicleSamples
from openjax.flying.set_point import RATES, SetPoint
from openjax.vehicle import load_vehicle
from openjax.virtual_crazyflie.firmware import STEP
from openjax.virtual_crazyflie.link import LinkFaults, VirtualLink
from openjax.virtual_crazyflie.vehicles import VirtualVehicles

ROWS = 5
"""Steps in a tick of the loop."""


def test_motors_answer_the_set_point_of_their_moment():
    """They were logged a step late: a rate loop seemed to have other gains."""
    vehicles = VirtualVehicles(load_vehicle(), [(0.0, 0.0, 1.0)])
    before = vehicles.advance(np.array([SetPoint(RATES, thrust=0.5)], np.float32), 3)
    after = vehicles.advance(np.array([SetPoint(RATES, thrust=0.6)], np.float32), 0)
    assert before.motor_command.mean() == pytest.approx(0.5, abs=1e-4)
    assert after.motor_command.mean() == pytest.approx(0.6, abs=1e-4)
    np.testing.assert_array_equal(before.specific_force, after.specific_force)
    np.testing.assert_array_equal(before.velocity, after.velocity)


def test_no_packet_acts_before_it_came():
    link = VirtualLink("127.0.0.1", 0, LinkFaults(), 0)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sender.sendto(b"\xff", ("127.0.0.1", link.port))
        deadline = time.monotonic() + 10.0
        while math.isinf(link.next_due()) and time.monotonic() < deadline:
            link.poll(1.45 * STEP)
        assert link.next_due() == pytest.approx(2.0 * STEP)
        assert not list(link.received(1.9 * STEP))
    finally:
        sender.close()
        link.close()


def half(values, unit: float = math.pi / 180.0):
    """Values as a packet holds them: half-precision numbers of a unit."""
    return unit * (values / unit).astype(np.float16).astype(float)


def flown(folder, seed: int, seconds: float):
    """A nominal flight in simulated time, logged as `openjax fly` logs it: three
    vehicles under commands that change at random.
    """
    rng = np.random.default_rng(seed)
    vehicles = VirtualVehicles(load_vehicle(), [(0.4 * i, 0.0, 20.0) for i in range(3)])
    hover = nominal_airframe().hover_thrust
    poses, bodies = [[] for _ in range(3)], [[] for _ in range(3)]
    sent_at, commands = [], []
    command = np.tile(np.array(SetPoint(RATES, thrust=hover), np.float32), (3, 1))
    rates = np.zeros((3, 3))
    for tick in range(int(100 * seconds)):
        if tick % 8 == 0:
            rates = rng.uniform(-0.7, 0.7, (3, 3))
        q = vehicles.report.quaternion
        # random turns about level; columns: mode, roll, pitch, yaw rate, thrust
        level = np.stack([-4.0 * q[:, 1], -4.0 * q[:, 2], np.zeros(3)], 1)
        sinking = vehicles.report.velocity[:, 2:]
        thrust = np.clip(hover - 0.1 * sinking + rng.normal(0.0, 0.03, (3, 1)), 0.2, 0.9)
        new = np.concatenate([np.full((3, 1), RATES), level + rates, thrust], 1)
        for step in range(ROWS):
            moment = (ROWS * tick + step) * STEP
            if step == 2:
                command = new.astype(np.float32)
                sent_at.append(moment - 1e-4)
                commands.append(new[:, [0, 4, 1, 2, 3]])
                vehicles.advance(command, 0)
            report = vehicles.report
            for i in range(3):
                sensed = (*half(report.specific_force[i], 9.81), *half(report.body_rates[i]))
                bodies[i].append((moment, *report.motor_command[i], *sensed))
                if step == 0:
                    place = np.round([*report.position[i], *report.velocity[i]], 3)
                    attitude = expand_quaternion(compress_quaternion(report.quaternion[i]))
                    poses[i].append((moment, 4.0, moment, *place, *attitude, *sensed[3:]))
            vehicles.advance(command, 1)
    samples = [
        VehicleSamples(np.array(p), np.array(b), np.zeros((0, 14)))
        for p, b in zip(poses, bodies, strict=True)
    ]
    log = GameLog(0)
    piece = log.piece(samples, np.array(sent_at), np.array(commands), np.inf)
    (folder / log.name).write_bytes(piece)
    (folder / "vehicle.toml").touch()
    return load_case(folder)


@pytest.mark.slow
def test_the_rate_loop_of_a_nominal_flight_is_the_simulators(tmp_path):
    """Motors logged a step late changed I and D by -0.2 to -0.5, a gyroscope that came
    at 100 Hz P by 0.1.
    """
    from openjax.gap.channels.rate_loop import RateLoop
    from openjax.gap.evidence import gather
    from openjax.gap.model.library import Library

    evidence = gather(flown(tmp_path, 0, 10.0), Library())
    (loop,) = (channel for channel in evidence.channels if isinstance(channel, RateLoop))
    change, error = loop.gain
    assert abs(change[0]) < 0.01 and error[0] < 0.01
    assert np.abs(change).max() < 0.1
    assert not loop.acting()

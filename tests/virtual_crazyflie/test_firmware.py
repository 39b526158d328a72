"""The virtual firmware: the protocol by the bytes, watchdogs, hostile packets."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.errors import UserError
from openjax.flying.crtp import (
    Packet,
    Port,
    compress_quaternion,
    decode,
    expand_quaternion,
    pack_number,
)
from openjax.flying.motion_capture import find_feed
from openjax.flying.set_point import ANGLES, OFF, RATES, SetPoint
from openjax.virtual_crazyflie.firmware import LEVEL_AFTER, STOP_AFTER, WATCHDOG, VirtualFirmware
from openjax.virtual_crazyflie.link import LinkFaults, VirtualLink
from openjax.virtual_crazyflie.tables import LOG_VARIABLES, Sensors

SENSORS = Sensors(
    np.array([0.5, -0.25, 1.0]),
    np.array([0.1, 0.2, -0.3]),
    np.array([0.6, 0.0, 0.8, 0.0]),
    np.array([0.1, -0.2, 0.3]),
    np.array([0.0, 1.0, 9.81]),
    np.array([0.1, 0.2, 0.3, 0.4]),
    3.7,
)


def ask(firmware, port, channel, data, now=0.0):
    return [
        decode(raw) for raw in firmware.receive(Packet(port, channel, bytes(data)).encode(), now)
    ]


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_come_out_of_32_bits_as_the_same_attitude(wxyz):
    wxyz = np.array(wxyz) / np.linalg.norm(wxyz)
    again = expand_quaternion(compress_quaternion(wxyz))
    assert 2 * np.arccos(min(1.0, abs(again @ wxyz))) < 5e-3


def test_integers_are_cut_to_what_they_hold():
    assert pack_number("h", 1e9) == struct.pack("<h", 32767)
    assert pack_number("H", -5) == b"\0\0"
    assert pack_number("e", -1e300) == struct.pack("<e", -np.inf)


def test_a_log_block_holds_what_was_asked_for_in_its_units_and_order():
    firmware = VirtualFirmware()
    names = list(LOG_VARIABLES)
    wanted = [("stateEstimateZ.x", 5), ("gyro.y", 8), ("motor.m3", 2), ("pm.vbatMV", 2)]
    block = b"".join(struct.pack("<BH", kind, names.index(name)) for name, kind in wanted)
    assert ask(firmware, Port.LOG, 1, bytes([6, 9]) + block)[0].data == bytes([6, 9, 0])
    assert ask(firmware, Port.LOG, 1, [3, 9, 1])[0].data == bytes([3, 9, 0])
    assert firmware.logs.packets(firmware, 0.009, SENSORS) == []
    (raw,) = firmware.logs.packets(firmware, 0.0101, SENSORS)
    packet = decode(raw)
    assert packet.data[:4] == bytes([9, 10, 0, 0])
    x, gyro, motor, voltage = struct.unpack("<heHH", packet.data[4:])
    assert (x, voltage) == (500, 3700)
    assert gyro == pytest.approx(np.degrees(-0.2), rel=1e-3)
    assert motor == round(0.3 * 65535)
    # late or not, the next ones stay in step with the start
    assert firmware.logs.packets(
        firmware, 0.0377, SENSORS
    ) and firmware.logs.next() == pytest.approx(0.04)


def test_a_block_longer_than_a_packet_is_refused():
    firmware = VirtualFirmware()
    one = struct.pack("<BH", 7, 0)
    assert ask(firmware, Port.LOG, 1, bytes([6, 1]) + 6 * one)[0].data[2] == 0
    assert ask(firmware, Port.LOG, 1, bytes([7, 1]) + one)[0].data[2] != 0


def test_old_set_points_are_levelled_and_then_stop_the_motors():
    firmware = VirtualFirmware(needs_arming=False)
    firmware.accept(SetPoint(RATES, 1.0, 2.0, 3.0, 0.6), 10.0)
    assert firmware.set_point(10.4).roll == 1.0
    assert firmware.set_point(10.01 + LEVEL_AFTER) == SetPoint(ANGLES, 0.0, 0.0, 0.0, 0.6)
    assert firmware.set_point(10.01 + STOP_AFTER).mode == OFF


def test_a_vehicle_that_was_stopped_can_be_armed_and_flown_again():
    firmware = VirtualFirmware()
    ask(firmware, Port.SUPERVISOR, 1, [1, 0])
    # the stop at the end of a flight
    ask(firmware, Port.COMMANDER_GENERIC, 0, [0], 1.0)
    ask(firmware, Port.SUPERVISOR, 1, [1, 1], 10.0)
    assert firmware.set_point(10.0).mode == OFF
    firmware.accept(SetPoint(RATES, thrust=0.6), 10.1)
    assert firmware.set_point(10.1).mode == RATES


def test_nothing_turns_before_arming_nor_after_an_emergency():
    firmware = VirtualFirmware()
    firmware.accept(SetPoint(ANGLES, thrust=0.6), 0.0)
    assert firmware.set_point(0.0).mode == OFF
    assert ask(firmware, Port.SUPERVISOR, 1, [1, 1])[0].data == bytes([0x81, 1, 1])
    firmware.accept(SetPoint(ANGLES, thrust=0.6), 0.1)
    assert firmware.set_point(0.1).mode == ANGLES
    ask(firmware, Port.SUPERVISOR, 1, [3], 0.2)
    firmware.accept(SetPoint(ANGLES, thrust=0.6), 0.2)
    assert firmware.set_point(0.2).mode == OFF


def test_the_watchdog_bites_once_it_was_fed():
    firmware = VirtualFirmware(needs_arming=False)
    ask(firmware, Port.SUPERVISOR, 1, [4], 0.0)
    for now in (0.5, 1.01 * WATCHDOG):
        firmware.accept(SetPoint(ANGLES, thrust=0.6), now)
        assert firmware.set_point(now).mode == (ANGLES if now < WATCHDOG else OFF)


@settings(max_examples=300)
@given(st.binary(max_size=31), st.integers(0, 255))
def test_no_packet_breaks_it(data, header):
    firmware = VirtualFirmware()
    for raw in (data, bytes([header]) + data):
        for answer in firmware.receive(raw, 1.0):
            assert 1 <= len(answer) <= 31
    assert np.isfinite(firmware.set_point(1.0)).all()


@pytest.mark.parametrize("host, port", [("127.0.0.1", 65536), ("nohost.invalid", 1), ("x" * 80, 1)])
def test_an_address_that_cannot_be_had_is_named(host, port):
    with pytest.raises(UserError, match=f"UDP port {port} of {host} can't be opened"):
        VirtualLink(host, port, LinkFaults(), 0)


@pytest.mark.parametrize("name", ["nomodule:feed", "os:nothing", "os:sep", "nonsense"])
def test_a_feed_that_is_none_is_named(name):
    with pytest.raises(UserError, match=f"--motion_capture {name}"):
        find_feed(name)

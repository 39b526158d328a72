"""A Crazyflie's firmware as it answers over CRTP: parameters, log blocks, set-points, arming,
external pose.

One vehicle, without sockets or clock: packets in, packets out. Set-points of body rates
or angles with thrust are flown; position set-points, trajectories and memories are not
there.
"""

import errno
import struct

import numpy as np

from openjax.flying.crtp import (
    FULL_SCALE,
    LOG_TYPES,
    PARAMETER_TYPES,
    PROTOCOL_VERSION,
    READ_ONLY,
    Port,
    Supervisor,
    SupervisorCommand,
    decode,
    pack_number,
)
from openjax.flying.set_point import ANGLES, OFF, RATES, SetPoint
from openjax.virtual_crazyflie.logs import MAX_BLOCKS, MAX_VARIABLES, LogBlocks
from openjax.virtual_crazyflie.tables import (
    LOG_CRC,
    LOG_NAMES,
    LOG_VARIABLES,
    PARAMETER_CRC,
    PARAMETER_NAMES,
    PARAMETERS,
    READ_ONLY_GROUP,
)

STEP = 0.002
"""Seconds between two runs of its loop: 500 Hz."""
LEVEL_AFTER = 0.5
"""Set-points older than this (s) are replaced by a level attitude at the same thrust
(firmware: supervisor.c, a constant).
"""
STOP_AFTER = 2.0
"""Set-points older than this (s) stop the motors and disarm."""
WATCHDOG = 1.0
"""Once an emergency-stop watchdog was started, it stops the motors unless it is
repeated within this time (s).
"""
THRUST_CUT = 60000
"""The legacy commander cuts thrust here and takes less than 1000 as none (16 bit)."""


class VirtualFirmware:
    """One virtual Crazyflie's firmware. Times are seconds of one clock that the caller
    owns.
    """

    def __init__(self, needs_arming: bool = True):
        """`needs_arming`: motors stay off until armed; otherwise armed from the start,
        as on brushed Crazyflies.
        """
        self.auto_arm = not needs_arming
        self.level_after = LEVEL_AFTER
        # what a restart keeps is set above, all else by it
        self.restart()

    def restart(self) -> None:
        """Switch it off and on."""
        self.armed = self.auto_arm
        self.crashed = False
        self.emergency = False
        self.flying = False
        # position, quaternion wxyz
        self.external_pose = np.array([0, 0, 0, 1, 0, 0, 0], float)
        self.external_poses = 0
        self.parameters = {name: value for name, (_, value) in PARAMETERS.items()}
        self.logs = LogBlocks()
        self._set_point = SetPoint()
        self._set_point_time: float | None = None
        self._watchdog_time: float | None = None
        self.set_points = 0

    # -- set-points and supervision

    @property
    def supervisor_info(self) -> int:
        """The supervisor's bits: can be armed, is armed, auto arming, can fly, is
        flying, tumbled, locked, crashed.
        """
        ready = not (self.crashed or self.emergency)
        holds = {
            Supervisor.CAN_BE_ARMED: ready and not self.armed,
            Supervisor.ARMED: self.armed,
            Supervisor.AUTO_ARM: self.auto_arm,
            Supervisor.CAN_FLY: ready and self.armed,
            Supervisor.FLYING: self.flying,
            Supervisor.TUMBLED: self.crashed,
            Supervisor.LOCKED: self.emergency,
            Supervisor.CRASHED: self.crashed,
        }
        return sum(int(bit) for bit, is_so in holds.items() if is_so)

    def set_point(self, time: float) -> SetPoint:
        """The set-point that the stabiliser gets at `time`, watchdogs and supervision included."""
        if self._watchdog_time is not None and time - self._watchdog_time > WATCHDOG:
            self.emergency = True
        if self._set_point_time is None or not self.armed or self.crashed or self.emergency:
            return SetPoint()
        age = time - self._set_point_time
        # nothing to time out: an armed vehicle waits for its first set-point
        if self._set_point.mode == OFF:
            return SetPoint()
        if age > STOP_AFTER:
            self._disarm()
            return SetPoint()
        if age > self.level_after:
            return SetPoint(ANGLES, 0.0, 0.0, 0.0, self._set_point.thrust)
        return self._set_point

    def feed_watchdog(self, time: float) -> None:
        """Start or restart the emergency-stop watchdog."""
        self._watchdog_time = time

    def crash(self) -> None:
        """The vehicle hit something: motors off until a recovery is asked for."""
        self.crashed = True
        self._disarm()

    def _disarm(self):
        self.armed = self.auto_arm
        self._set_point = SetPoint()
        self._set_point_time = None

    # -- packets in

    def receive(self, raw: bytes, time: float) -> list[bytes]:
        """Answers to one packet. What can't be understood is left without one, as on
        board.
        """
        if not raw:
            return []
        if raw == b"\xff":  # the null packet of a scan
            return [raw]
        # to the radio's processor, which switches this one off and on
        if raw[:2] == b"\xff\xfe":
            if raw[2:3] == b"\x03":
                self.restart()
            return [raw]
        packet = decode(raw)
        handler = {
            Port.LINK: self._link,
            Port.PLATFORM: self._platform,
            Port.SUPERVISOR: self._supervisor,
            Port.LOG: self._log,
            Port.PARAMETERS: self._parameter,
            Port.MEMORY: self._memory,
            Port.LOCALIZATION: self._localization,
            Port.COMMANDER: self._commander,
            Port.COMMANDER_GENERIC: self._generic,
        }.get(packet.port)
        if handler is None:
            return []
        try:
            answers = handler(packet, time)
        except (struct.error, IndexError):  # shorter than its kind
            return []
        return [answer.encode() for answer in answers]

    def _link(self, packet, time):
        if packet.channel == 0:  # echo
            return [packet]
        return [packet._replace(data=b"Bitcraze Crazyflie\0")] if packet.channel == 1 else []

    def _platform(self, packet, time):
        command = packet.data[0]
        if packet.channel == 1:
            answers = {0: bytes([PROTOCOL_VERSION]), 1: b"openjax virtual", 2: b"CF21"}
            answer = answers.get(command, b"")
            return [packet._replace(data=bytes([command]) + answer)]
        if packet.channel == 0 and command == 1:
            return [packet._replace(data=bytes([command, *self._arm(bool(packet.data[1]))]))]
        return []

    def _arm(self, do_arm):
        """Success, and whether it's armed now."""
        if do_arm:
            success = not (self.crashed or self.emergency)
            self.armed = success or self.auto_arm
        else:
            success = True
            self._disarm()
        return int(success), int(self.armed)

    def _supervisor(self, packet, time):
        command = packet.data[0]
        answer = None
        if packet.channel == 0 and command == 0x0C:
            answer = struct.pack("<H", self.supervisor_info)
        elif packet.channel == 1 and command == SupervisorCommand.ARM:
            answer = bytes(self._arm(bool(packet.data[1])))
        elif packet.channel == 1 and command == SupervisorCommand.RECOVER:
            self.crashed = False
            answer = bytes([1, 1])
        elif packet.channel == 1 and command == SupervisorCommand.EMERGENCY_STOP:
            self.emergency = True
            answer = b""
        elif packet.channel == 1 and command == SupervisorCommand.FEED_WATCHDOG:
            self.feed_watchdog(time)
            answer = b""
        return [] if answer is None else [packet._replace(data=bytes([command | 0x80]) + answer)]

    def _memory(self, packet, time):
        """The number of memories: none."""
        if packet.channel == 0 and packet.data[0] == 1:
            return [packet._replace(data=b"\x01\x00")]
        return []

    def _localization(self, packet, time):
        """On channel 0 an external position; on the other, by the first byte: 8 an
        external pose, 3 an emergency stop, 4 a word to its watchdog.
        """
        if packet.channel == 0:
            self.external_pose[:3] = struct.unpack("<3f", packet.data[:12])
            self.external_poses += 1
        elif packet.data[0] == 8:
            # scalar last in the packet, first everywhere else
            x, y, z, qx, qy, qz, qw = struct.unpack("<7f", packet.data[1:29])
            self.external_pose[:] = x, y, z, qw, qx, qy, qz
            self.external_poses += 1
        elif packet.data[0] == 3:
            self.emergency = True
        elif packet.data[0] == 4:
            self.feed_watchdog(time)
        return []

    def _commander(self, packet, time):
        """The legacy set-point, of which a parameter says whether it is angles."""
        *degrees, thrust = struct.unpack("<fffH", packet.data[:14])
        # the firmware's dead band: so little thrust means none
        thrust = 0 if thrust < 1000 else min(thrust, THRUST_CUT)
        rates = self.parameters["flightmode.stabModeRoll"] == 0
        self._accept(RATES if rates else ANGLES, degrees, thrust, time)
        return []

    def _generic(self, packet, time):
        """By the first byte: 0 stop, 11 the set-point that `cflib` calls manual."""
        if packet.channel != 0:
            return []
        if packet.data[0] == 0:
            self._set_point = SetPoint()
            self._set_point_time = time
            self.set_points += 1
        elif packet.data[0] == 11:
            *degrees, thrust, rates = struct.unpack("<fffHB", packet.data[1:16])
            self._accept(RATES if rates else ANGLES, degrees, thrust, time)
        return []

    def _accept(self, mode, degrees, thrust, time):
        """Roll, pitch, yaw rate in the firmware's frame, where pitch points the other
        way.
        """
        if np.isfinite(degrees).all():
            roll, pitch, yaw_rate = np.radians(degrees).tolist()
            self.accept(SetPoint(mode, roll, -pitch, yaw_rate, thrust / (FULL_SCALE + 1)), time)

    def accept(self, set_point: SetPoint, time: float) -> None:
        """Take a set-point as it comes out of a packet: no thrust means motors off."""
        self.set_points += 1
        self._set_point_time = time
        self._set_point = SetPoint() if set_point.thrust == 0.0 else set_point

    # -- tables of contents

    def _contents(self, packet, names, crc, limits, type_of):
        """A table of contents: its size and checksum (command 3), or one of its entries
        (2).
        """
        command = packet.data[0]
        if command == 3:
            return [packet._replace(data=struct.pack("<BHI", 3, len(names), crc) + limits)]
        if command == 2:
            (ident,) = struct.unpack("<H", packet.data[1:3])
            if ident >= len(names):
                return [packet._replace(data=b"\x02")]
            name = names[ident].replace(".", "\0").encode() + b"\0"
            return [packet._replace(data=packet.data[:3] + bytes([type_of(names[ident])]) + name)]
        return []

    def _log(self, packet, time):
        if packet.channel == 0:
            return self._contents(
                packet,
                LOG_NAMES,
                LOG_CRC,
                bytes([MAX_BLOCKS, MAX_VARIABLES]),
                lambda name: LOG_TYPES[LOG_VARIABLES[name][0]][0],
            )
        if packet.channel != 1:
            return []
        command = packet.data[0]
        ident = packet.data[1] if len(packet.data) > 1 else 0
        status = self.logs.control(command, ident, packet.data, time)
        return [packet._replace(data=bytes([command, ident, status]))]

    def _parameter(self, packet, time):
        if packet.channel == 0:

            def type_of(name):
                read_only = name.split(".")[0] == READ_ONLY_GROUP
                return PARAMETER_TYPES[PARAMETERS[name][0]][0] | (READ_ONLY if read_only else 0)

            return self._contents(packet, PARAMETER_NAMES, PARAMETER_CRC, b"", type_of)
        if packet.channel in (1, 2):
            (ident,) = struct.unpack("<H", packet.data[:2])
            if ident >= len(PARAMETER_NAMES):
                return [packet._replace(data=packet.data[:2] + bytes([errno.ENOENT]))]
            name = PARAMETER_NAMES[ident]
            fmt = PARAMETER_TYPES[PARAMETERS[name][0]][1]
            if packet.channel == 2 and name.split(".")[0] != READ_ONLY_GROUP:
                (self.parameters[name],) = struct.unpack("<" + fmt, packet.data[2:])
            status = b"\0" if packet.channel == 1 else b""
            value = pack_number(fmt, self.parameters[name])
            return [packet._replace(data=packet.data[:2] + status + value)]
        return [packet._replace(data=packet.data[:3] + bytes([errno.ENOENT]))]

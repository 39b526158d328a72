"""CRTP, the protocol between a Crazyflie and a ground station: ports, types, packed numbers.

Facts from Bitcraze's protocol documentation
(https://www.bitcraze.io/documentation/repository/crazyflie-firmware/
master/functional-areas/crtp/); a packet is one byte of header and up to 30 bytes of data.
"""

import math
import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

PROTOCOL_VERSION = 12
"""The version answered: tables of contents with 16-bit ids (4 and up), arming by the
supervisor's port (12).
"""
MAX_LOG_DATA = 26
"""Bytes of variables in one log packet; the rest is the block's id and the time stamp."""
FULL_SCALE = 65535
"""Motor commands, thrust set-points: 16 bit."""


class Port(IntEnum):
    """Ports of packets."""

    PARAMETERS = 0x2
    COMMANDER = 0x3
    MEMORY = 0x4
    LOG = 0x5
    LOCALIZATION = 0x6
    COMMANDER_GENERIC = 0x7
    SUPERVISOR = 0x9
    PLATFORM = 0xD
    LINK = 0xF


class Supervisor(IntFlag):
    """The bits of `supervisor.info`: what the firmware says of its vehicle."""

    CAN_BE_ARMED = 1
    ARMED = 2
    AUTO_ARM = 4
    CAN_FLY = 8
    FLYING = 16
    TUMBLED = 32
    LOCKED = 64
    CRASHED = 128


class SupervisorCommand(IntEnum):
    """First byte of a packet on the supervisor's channel 1."""

    ARM = 1
    RECOVER = 2
    EMERGENCY_STOP = 3
    FEED_WATCHDOG = 4


class LogCommand(IntEnum):
    """First byte of a packet on the log port's channel 1, with 16-bit ids of variables."""

    DELETE = 2
    START = 3  # with a period in units of 10 ms
    STOP = 4
    RESET = 5  # all blocks go
    CREATE = 6
    APPEND = 7
    START_IN_MS = 8


class Packet(NamedTuple):
    """One packet: port 0..15, channel 0..3, data."""

    port: int
    channel: int
    data: bytes

    def encode(self) -> bytes:
        """The packet as it is sent. The two middle bits of the header are set, as ever."""
        return bytes([(self.port << 4) | 0x0C | self.channel]) + self.data


def decode(raw: bytes) -> Packet:
    """The packet in `raw`, which holds at least its header."""
    return Packet(raw[0] >> 4, raw[0] & 0x03, raw[1:])


# Names of C types -> (number in the table of contents, struct format).
LOG_TYPES = {
    "uint8_t": (1, "B"),
    "uint16_t": (2, "H"),
    "uint32_t": (3, "I"),
    "int8_t": (4, "b"),
    "int16_t": (5, "h"),
    "int32_t": (6, "i"),
    "float": (7, "f"),
    "FP16": (8, "e"),
}
PARAMETER_TYPES = {"uint8_t": (0x08, "B"), "uint16_t": (0x09, "H"), "float": (0x06, "f")}
READ_ONLY = 0x40
"""Added to a parameter's type in the table of contents."""
LOG_FORMATS = dict(LOG_TYPES.values())


def pack_number(fmt: str, value: float) -> bytes:
    """`value` in the struct format `fmt`, cut to what an integer type holds."""
    if fmt in "BHIbhi":
        span = 1 << 8 * struct.calcsize(fmt)
        low = -span // 2 if fmt.islower() else 0
        value = min(max(round(value), low), low + span - 1)
    try:
        return struct.pack("<" + fmt, value)
    except OverflowError:  # more than half or single precision holds
        return struct.pack("<" + fmt, math.copysign(math.inf, value))


def compress_quaternion(wxyz) -> int:
    """A unit quaternion (4,) wxyz in 32 bits: which component is largest, then sign and
    9 bits of the others.
    """
    w, x, y, z = map(float, wxyz)
    xyzw = (x, y, z, w)
    size = math.hypot(*xyzw)
    largest = max(range(4), key=lambda i: abs(xyzw[i]))
    word = largest
    for i, value in enumerate(xyzw):
        if i != largest:
            # q and -q are one attitude: signs are those of the one whose largest is positive
            negative = int((value < 0) != (xyzw[largest] < 0))
            # a component that isn't the largest is at most 1 / sqrt(2), for which 511 stands
            size_in_bits = min(round(511 * abs(value) / size * 2**0.5), 511)
            word = word << 10 | negative << 9 | size_in_bits
    return word


def expand_quaternion(word: int) -> tuple[float, float, float, float]:
    """wxyz from 32 bits, see `compress_quaternion`; precise to about 1e-3."""
    xyzw = [0.0] * 4
    largest = word >> 30
    square = 0.0
    for i in (3, 2, 1, 0):  # the last one packed stands in the lowest bits
        if i != largest:
            value = (word & 0x1FF) / 511 / 2**0.5
            xyzw[i] = -value if word & 0x200 else value
            square += value * value
            word >>= 10
    xyzw[largest] = max(0.0, 1.0 - square) ** 0.5
    return (xyzw[3], *xyzw[:3])

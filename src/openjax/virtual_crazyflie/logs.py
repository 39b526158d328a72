"""The log blocks of a virtual Crazyflie's firmware: set up by packets, sent when they
are due.
"""

import errno
import struct
from dataclasses import dataclass, field

import numpy as np

from openjax.flying.crtp import LOG_FORMATS, MAX_LOG_DATA, LogCommand, Packet, Port, pack_number
from openjax.virtual_crazyflie.tables import LOG_NAMES, LOG_VARIABLES, Sensors

MAX_BLOCKS = 16
"""Of a vehicle, as on board."""
MAX_VARIABLES = 128
"""In all blocks together, as on board."""
SAME = 1e-6
"""Moments less apart (s) are one: sums of periods are off by roundings."""


@dataclass
class _Block:
    """One block, stopped when it is made."""

    # name, struct format
    variables: list[tuple[str, str]] = field(default_factory=list)
    period: float = 0.0  # s; 0 while stopped
    due: float = 0.0  # s

    def size(self) -> int:
        return sum(struct.calcsize(fmt) for _, fmt in self.variables)


class LogBlocks:
    """The blocks of one vehicle. Times are seconds of one clock that the caller
    owns.
    """

    def __init__(self):
        self._blocks: dict[int, _Block] = {}

    def control(self, command: int, ident: int, data: bytes, time: float) -> int:
        """The status of a `LogCommand` on the block `ident`: 0 or an errno."""
        if command == LogCommand.RESET:
            self._blocks.clear()
            return 0
        if command == LogCommand.CREATE:
            if ident in self._blocks:
                return errno.EEXIST
            if len(self._blocks) >= MAX_BLOCKS:
                return errno.ENOMEM
            self._blocks[ident] = _Block()
            return self._append(ident, data[2:])
        if command not in set(LogCommand):
            return errno.ENOEXEC
        if ident not in self._blocks:
            return errno.ENOENT
        block = self._blocks[ident]
        if command == LogCommand.DELETE:
            del self._blocks[ident]
        elif command == LogCommand.STOP:
            block.period = 0.0
        elif command == LogCommand.APPEND:
            return self._append(ident, data[2:])
        else:
            block.period = data[2] * 0.01
            if command == LogCommand.START_IN_MS:
                block.period = struct.unpack("<H", data[2:4])[0] * 1e-3
            block.due = time + block.period
        return 0

    def _append(self, ident, data) -> int:
        block = self._blocks[ident]
        for kind, variable in struct.iter_unpack("<BH", data[: len(data) // 3 * 3]):
            # the upper four bits say in which type the memory holds it, the lower ones
            # as which it is sent
            sent_as = kind & 0x0F
            if variable >= len(LOG_NAMES) or sent_as not in LOG_FORMATS:
                return errno.ENOENT
            fmt = LOG_FORMATS[sent_as]
            if block.size() + struct.calcsize(fmt) > MAX_LOG_DATA:
                return errno.E2BIG
            if sum(len(b.variables) for b in self._blocks.values()) >= MAX_VARIABLES:
                return errno.ENOMEM
            block.variables.append((LOG_NAMES[variable], fmt))
        return 0

    def next(self) -> float:
        """The time at which the next log packet is due (s); infinite if no block runs."""
        return min((b.due for b in self._blocks.values() if b.period > 0), default=np.inf)

    def packets(self, firmware, time: float, sensors: Sensors) -> list[bytes]:
        """The log packets due at `time`, stamped with it in milliseconds."""
        packets = []
        for ident, block in self._blocks.items():
            if block.period <= 0 or time + SAME < block.due:
                continue
            # in step with its start; what came due in between is left out
            late = max(time - block.due, 0.0)
            block.due += block.period * (1 + int(late / block.period))
            stamp = struct.pack("<I", int(time * 1000) & 0xFFFFFF)[:3]
            values = b"".join(
                pack_number(fmt, LOG_VARIABLES[name][1](firmware, sensors))
                for name, fmt in block.variables
            )
            packets.append(Packet(Port.LOG, 2, bytes([ident]) + stamp + values).encode())
        return packets

"""Links without `cflib`'s vehicle around them, for whoever takes over from the links' process."""

import math
import struct
import time
from collections.abc import Sequence

from openjax.flying.crazyflie_links import never_wait, send_set_point
from openjax.flying.crtp import LOG_TYPES, Port, SupervisorCommand
from openjax.flying.member import POSE_BLOCK, SwarmMember
from openjax.flying.set_point import SetPoint
from openjax.flying.state import PoseSample
from openjax.flying.swarm import WATCHDOG_PERIOD


class RawLinks:
    """Links without `cflib`'s vehicle around them: packets of the pose block in, set-points out.

    Args:
      uris: of the vehicles.
      pose_blocks: ids of their pose blocks, which other links have set up.
      watchdog: whether those feed the firmware's watchdog, which bites if nobody goes
      on.
    """

    def __init__(self, uris: Sequence[str], pose_blocks: Sequence[int], watchdog: bool = True):
        self._members: list[SwarmMember] = []
        self._blocks = tuple(pose_blocks)
        self._links = dict.fromkeys(uris)
        self._watchdog = watchdog
        self._fed = -math.inf
        self._names = [name for name, _ in POSE_BLOCK]
        self._layout = "<" + "".join(LOG_TYPES[kind][1] for _, kind in POSE_BLOCK)

    def open(self, udp_only: bool = False) -> None:
        """Open what isn't open yet."""
        import cflib.crtp

        # once a process: the library keeps what it found
        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        self._members = self._members or [SwarmMember(uri) for uri in self._links]
        for uri, link in self._links.items():
            # a dongle belongs to one process: as long as the links' process has it, it
            # can't be opened
            if link is None and (uri.startswith("udp:") or not udp_only):
                self._links[uri] = cflib.crtp.get_link_driver(uri, lambda *_: None, lambda *_: None)
                never_wait(self._links[uri])

    def observe(self) -> tuple[PoseSample, ...]:
        """The latest samples of each vehicle, after the packets that have arrived."""
        for member, link, block in zip(
            self._members, self._links.values(), self._blocks, strict=True
        ):
            while (packet := link.receive_packet(0)) is not None:
                member.last_contact = time.perf_counter()
                data = bytes(packet.data)
                if (packet.port, packet.channel) != (Port.LOG, 2) or data[:1] != bytes([block]):
                    continue
                # block, three bytes of time, and the variables
                if len(data) == 4 + struct.calcsize(self._layout):
                    values = dict(
                        zip(self._names, struct.unpack(self._layout, data[4:]), strict=True)
                    )
                    member.pose_arrived(int.from_bytes(data[1:4], "little"), values)
        return tuple(member.sample() for member in self._members)

    def send(self, set_points: Sequence[SetPoint]) -> float:
        """Send each vehicle its set-point; returns when the last one left (s)."""
        for link, set_point in zip(self._links.values(), set_points, strict=True):
            send_set_point(link, set_point)
        time_read = time.perf_counter()
        if self._watchdog and time_read - self._fed > WATCHDOG_PERIOD:
            self._fed = time_read
            self._supervise(SupervisorCommand.FEED_WATCHDOG)
        return time_read

    def arm(self, on: bool) -> None:
        """Arm or disarm all."""
        self._supervise(SupervisorCommand.ARM, on)

    def _supervise(self, *data: int):
        from cflib.crtp.crtpstack import CRTPPacket

        for link in self._links.values():
            packet = CRTPPacket()
            packet.set_header(Port.SUPERVISOR, 1)
            packet.data = data
            link.send_packet(packet)

    def close(self) -> None:
        """Close all."""
        for link in self._links.values():
            if link is not None:
                link.close()

"""The vehicles over `cflib`: connections, log blocks in, set-points out. `cflib` is
GPLv3 and an extra.
"""

import contextlib
import logging
import math
import struct
import threading
import warnings
from collections.abc import Sequence
from time import perf_counter, sleep

from openjax.errors import UserError
from openjax.flying.crazyflie_links import never_wait, restart, send_set_point
from openjax.flying.member import BODY_BLOCK, PERIOD_MS, POSE_BLOCK, SwarmMember
from openjax.flying.set_point import SetPoint
from openjax.flying.state import PoseSample

WATCHDOG_PERIOD = 0.1
"""s between two words to the firmware's watchdog."""
CONNECTING = 3
"""Attempts to connect: over UDP nothing is sent again, and one lost answer leaves
`cflib` waiting.
"""
TRIES = 5
"""To have the log blocks sampled at different moments."""


class Swarm:
    """Crazyflies, real or virtual, in one process. `openjax.flying.links` runs it in
    one of its own.

    Args:
      uris: as `cflib` writes them: `radio://0/80/2M/E7E7E7E7E7`,
      `udp://127.0.0.1:19850`.
      body_logs: log blocks of motors and accelerometer for each vehicle, spread over
      the 10 ms; more of them tell the diagnosis more exactly when a command arrived,
      and take more of the link. 0 to 5.
      watchdog: feed the firmware's emergency-stop watchdog: motors stop 1 s after the
      last set-point, instead of 2 s. Once it was fed it bites, also after a normal
      flight, and the vehicle is locked; `connect` restarts such vehicles.
    """

    def __init__(self, uris: Sequence[str], body_logs: int = 1, watchdog: bool = True):
        self._body_logs = body_logs
        self._watchdog = watchdog
        self._fed = -math.inf
        self.members = [SwarmMember(uri) for uri in uris]

    def connect(self, timeout: float = 20.0) -> None:
        """Open all links and start the log blocks.

        Raises:
          UserError: cflib isn't there, a vehicle doesn't answer, or lacks a variable.
        """
        try:
            import cflib.crtp
            from cflib.crazyflie import Crazyflie
        except ImportError as error:
            raise UserError(
                f"{error.name or 'cflib'} is missing: pip install cflib (it is GPLv3)"
            ) from error
        for name in ("cflib.crazyflie", "cflib.crazyflie.toccache", "cflib.crazyflie.log"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        # cflib's list of drivers is the process' own: a second call would add them again
        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        try:
            for member in self.members:
                self._open(member, Crazyflie, timeout)
            self._start_logs(timeout)
            for member in self.members:
                never_wait(member.crazyflie.link)
        except BaseException:
            self.close()
            raise

    def _open(self, member, make, timeout):
        """Connect to one vehicle, restarting it once if it is locked."""
        for attempt in range(CONNECTING):
            if self._answers(member, make, timeout / CONNECTING):
                if attempt or not member.crazyflie.supervisor.is_locked:
                    return
                restart(member.uri, member.crazyflie)
        question = "is the vehicle on"
        if member.uri.startswith("udp:"):
            question = "does openjax virtual_crazyflie run"
        reason = member.error or "locked"
        raise UserError(f"{member.uri}: no connection ({reason}); {question}, is the URI right?")

    def _answers(self, member, make, timeout) -> bool:
        """True if the vehicle has sent all that `cflib` asks for."""
        answered_event = threading.Event()
        member.error = None
        member.crazyflie = crazyflie = make()
        crazyflie.fully_connected.add_callback(lambda _uri: answered_event.set())

        def on_failure(_uri, message):
            member.error = str(message).strip().splitlines()[0]
            answered_event.set()

        crazyflie.connection_failed.add_callback(on_failure)
        crazyflie.connection_lost.add_callback(on_failure)
        crazyflie.open_link(member.uri)
        if not answered_event.wait(timeout):
            member.error = f"no answer in {timeout:.1f} s"
        if member.error is not None:
            crazyflie.close_link()
        return member.error is None

    def _start_logs(self, timeout):
        """Set up and start each vehicle's log blocks, the pose's first."""
        from cflib.crazyflie.log import LogConfig

        kinds = [POSE_BLOCK] + [BODY_BLOCK] * self._body_logs
        for member in self.members:
            for number, kind in enumerate(kinds):
                block = LogConfig(f"openjax{number}", PERIOD_MS)
                for name, fetch_as in kind:
                    block.add_variable(name, fetch_as)
                arrival = member.pose_arrived if kind is POSE_BLOCK else member.body_arrived
                block.data_received_cb.add_callback(arrival)
                try:
                    member.crazyflie.log.add_config(block)
                except (KeyError, AttributeError) as error:
                    raise UserError(
                        f"{member.uri}: its firmware can't log what is needed ({error})"
                    ) from error
                block.start()
                member.blocks.append(block)
        deadline = perf_counter() + timeout
        while not all(b.started for m in self.members for b in m.blocks):
            if perf_counter() > deadline:
                raise UserError(f"the log blocks didn't start within {timeout:g} s")
            sleep(0.01)
        # once more, in step: a vehicle samples every 1 or 2 ms, and blocks that share a
        # sample leave a gap elsewhere
        for _ in range(TRIES):
            self._start_in_step()
            sleep(5e-3 * PERIOD_MS)
            if all(len(set(m.phases.values())) == self._body_logs for m in self.members):
                break

    def _start_in_step(self):
        """All poses at the same moment, the blocks of motors spread evenly over the 10 ms."""
        begin = perf_counter() + 0.01
        for number in range(1 + self._body_logs):
            due = begin + 1e-3 * PERIOD_MS * (number - 0.5) / self._body_logs if number else begin
            while perf_counter() < due:
                sleep(1e-4)
            for member in self.members:
                member.blocks[number].start()

    def arm(self, on: bool = True) -> None:
        """Arm or disarm all."""
        for member in self.members:
            if member.crazyflie is not None and member.crazyflie.link is not None:
                with warnings.catch_warnings():
                    # older firmware: cflib falls back by itself
                    warnings.simplefilter("ignore")
                    member.crazyflie.supervisor.send_arming_request(on)

    def pose_blocks(self) -> tuple[int, ...]:
        """The id of each vehicle's pose block."""
        return tuple(m.blocks[0].id for m in self.members)

    def observe(self) -> tuple[PoseSample, ...]:
        """The latest samples of each vehicle."""
        return tuple(member.sample() for member in self.members)

    def send(self, set_points: Sequence[SetPoint]) -> float:
        """Send each vehicle its set-point; returns when the last one left (s)."""
        for member, set_point in zip(self.members, set_points, strict=True):
            send_set_point(member.crazyflie, set_point)
        sent_at = perf_counter()
        if self._watchdog and sent_at - self._fed > WATCHDOG_PERIOD:
            self._fed = sent_at
            for member in self.members:
                member.crazyflie.supervisor.send_emergency_stop_watchdog()
        return sent_at

    def send_pose(self, i: int, position, quaternion) -> None:
        """Tell vehicle i where motion capture sees it: (3,) m, (4,) wxyz."""
        w, x, y, z = quaternion
        self.members[i].crazyflie.loc.send_extpose(tuple(position), (x, y, z, w))

    def close(self) -> None:
        """Motors off, disarmed, links closed."""
        self.arm(False)
        for member in self.members:
            if member.crazyflie is not None:
                # the link is gone already
                with contextlib.suppress(OSError, struct.error):
                    member.crazyflie.close_link()
                member.crazyflie = None

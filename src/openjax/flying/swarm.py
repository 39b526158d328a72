"""The vehicles over `cflib`: connections, log blocks in, set-points out. `cflib` is
GPLv3 and an extra.
"""

import contextlib
import logging
import math
import struct
import threading
import warnings
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, sleep

import numpy as np

from openjax.errors import UserError
from openjax.flying.controller import Pose, numbers_of
from openjax.flying.crtp import expand_quaternion
from openjax.flying.set_point import OFF, SetPoint, manual_arguments
from openjax.flying.state import FORCE_AGE, PoseSample

PERIOD_MS = 10
"""Of the log blocks: the shortest that the protocol knows."""
POSE_BLOCK = (
    *((f"stateEstimateZ.{v}", "int16_t") for v in ("x", "y", "z", "vx", "vy", "vz")),
    ("stateEstimateZ.quat", "uint32_t"),
    *((f"gyro.{v}", "FP16") for v in "xyz"),
    ("pm.vbatMV", "uint16_t"),
    ("supervisor.info", "uint16_t"),
)
BODY_BLOCK = (
    *((f"motor.m{i}", "uint16_t") for i in range(1, 5)),
    *((f"acc.{v}", "FP16") for v in "xyz"),
)
WATCHDOG_PERIOD = 0.1
"""s between two words to the firmware's watchdog."""
CONNECTING = 3
"""Attempts to connect: over UDP nothing is sent again, and one lost answer leaves
`cflib` waiting.
"""
BOOT = {"udp": 0.2, "radio": 5.0}
"""How long a restarted vehicle takes until it answers (s)."""
TRIES = 5
"""To have the log blocks sampled at different moments."""
DRIFT = 5e-5
"""How fast two clocks may part (s/s): quartzes are good to some tens of ppm."""
_WRAP = 1 << 24
"""Milliseconds after which a time stamp of three bytes begins again."""


class _Clock:
    """On-board milliseconds (24 bit) to host seconds: the packet that came through
    fastest sets the difference.
    """

    def __init__(self):
        self.offset = math.inf
        self._last = 0.0
        self._stamp = None
        self._base = 0

    def host(self, stamp: int, arrival: float) -> float:
        """Host seconds of a time stamp that came at `arrival` (s)."""
        # only a step back by half of the range is a new turn: packets may overtake each
        # other
        if self._stamp is not None and stamp < self._stamp - _WRAP // 2:
            self._base += _WRAP
        self._stamp = stamp
        on_board = 1e-3 * (stamp + self._base)
        # the smallest difference so far, let up by as much as clocks may have parted
        # since
        if math.isfinite(self.offset):
            self.offset += DRIFT * (arrival - self._last)
        self.offset = min(self.offset, arrival - on_board)
        self._last = arrival
        return on_board + self.offset


@dataclass(frozen=True)
class Samples:
    """What was recorded of one vehicle; times are host seconds. NumPy."""

    poses: np.ndarray
    """(K, 16) own estimates: arrival, voltage (V), when measured, position, velocity,
    quaternion, body rates.
    """
    bodies: np.ndarray
    """(K, 8): when measured, m1..m4 0..1, the specific force (m/s^2)."""
    seen: np.ndarray
    """(K, 14) by motion capture, where there is one: when measured, position, velocity,
    quaternion, body rates.
    """


class Member:
    """One vehicle of the swarm."""

    def __init__(self, uri: str):
        self.uri = uri
        self._onboard = _Clock()
        self.pose: Pose | None = None
        self.arrival = -math.inf  # host s, of the newest pose
        self.last_contact = perf_counter()
        self.voltage = math.nan
        self.supervisor = 0
        # host s, the newest specific force (m/s^2, body)
        self.felt: tuple = (-math.inf, None)
        self.error: str | None = None
        self.poses = array("d")  # rows as in `Samples`
        self.bodies = array("d")
        self.recording = False
        self.listener: Callable[[bool], None] = lambda new_pose: None
        self.crazyflie = None
        self.blocks: list = []
        # when in the period each block of motors was sampled last (ms)
        self.phases: dict = {}

    def sample(self) -> PoseSample:
        """What is known of it."""
        is_recent = (
            self.pose is not None and abs(self.pose.time - self.felt[0]) <= FORCE_AGE
        )
        return PoseSample(
            own=self.pose,
            last_contact=self.last_contact,
            voltage=self.voltage,
            supervisor=self.supervisor,
            force=self.felt[1] if is_recent else None,
        )

    def pose_arrived(self, stamp: int, data: dict, _block=None) -> None:
        """A pose block, called by cflib's thread."""
        arrival = perf_counter()
        values = [data[name] for name, _ in POSE_BLOCK]
        # in millimetres, mm/s, degrees/s and millivolts, so that all fits into one
        # packet
        pose = Pose(
            self._onboard.host(stamp, arrival),
            tuple(1e-3 * v for v in values[:3]),
            tuple(1e-3 * v for v in values[3:6]),
            expand_quaternion(values[6]),
            tuple(math.radians(v) for v in values[7:10]),
        )
        self.voltage = 1e-3 * values[10]
        self.supervisor = values[11]
        self.pose = pose
        self.arrival = arrival
        self.last_contact = arrival
        if self.recording:
            self.poses.extend((arrival, self.voltage, *numbers_of(pose)))
        self.listener(True)

    def body_arrived(self, stamp: int, data: dict, _block=None) -> None:
        """A block of motors and accelerometer."""
        arrival = perf_counter()
        self.last_contact = arrival
        self.phases[_block] = stamp % PERIOD_MS
        measured = self._onboard.host(stamp, arrival)
        force = tuple(9.81 * data[name] for name, _ in BODY_BLOCK[4:])
        if measured > self.felt[0]:  # packets may overtake each other
            self.felt = measured, force
        if self.recording:
            # motors are 16 bits, the accelerometer counts in g
            motors = tuple(data[name] / 65536 for name, _ in BODY_BLOCK[:4])
            self.bodies.extend((measured, *motors, *force))
        self.listener(False)


def send_set_point(crazyflie, set_point: SetPoint) -> None:
    """Send one vehicle its set-point. `crazyflie`: its own, or its link: it needs no
    more than `send_packet`.
    """
    from cflib.crazyflie.commander import Commander

    commander = Commander(crazyflie)
    if set_point.mode == OFF:
        commander.send_stop_setpoint()
    else:
        commander.send_setpoint_manual(*manual_arguments(set_point))


def never_wait(link) -> None:
    """Have packets wait for a link, and never who sends them: the newest of each kind,
    in the place of an older one.

    A radio's link has room for one until its vehicle acknowledges; `cflib` waits two
    seconds for a vehicle that doesn't, and meanwhile sends the others nothing. Over UDP
    nothing waits.
    """
    room = getattr(link, "out_queue", None)

    def send_packet(packet) -> bool:
        with room.mutex:
            waiting = [old.header for old in room.queue]
            if packet.header in waiting:
                room.queue[waiting.index(packet.header)] = packet
            else:
                room.queue.append(packet)
                room.not_empty.notify()
        return True

    if room is not None:
        link.send_packet = send_packet


def _restart(uri: str, crazyflie) -> None:
    """Restart a vehicle whose firmware is locked: its motors are off."""
    from cflib.utils.power_switch import PowerSwitch

    crazyflie.close_link()
    switch = PowerSwitch(uri)
    switch.stm_power_cycle()
    switch.close()
    sleep(BOOT[uri.split(":")[0]])


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
        self.members = [Member(uri) for uri in uris]

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
        for name in (
            "cflib.crazyflie",
            "cflib.crazyflie.toccache",
            "cflib.crazyflie.log",
        ):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        # cflib's list of drivers is the process' own: a second call would add them
        # again
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
                _restart(member.uri, member.crazyflie)
        question = "is the vehicle on"
        if member.uri.startswith("udp:"):
            question = "does openjax virtual_crazyflie run"
        why = member.error or "locked"
        raise UserError(
            f"{member.uri}: no connection ({why}); {question}, is the URI right?"
        )

    def _answers(self, member, make, timeout) -> bool:
        """Whether the vehicle has told all that `cflib` asks for."""
        answered_event = threading.Event()
        member.error = None
        member.crazyflie = crazyflie = make()
        crazyflie.fully_connected.add_callback(lambda _uri: answered_event.set())

        def failed(_uri, message):
            member.error = str(message).strip().splitlines()[0]
            answered_event.set()

        crazyflie.connection_failed.add_callback(failed)
        crazyflie.connection_lost.add_callback(failed)
        crazyflie.open_link(member.uri)
        if not answered_event.wait(timeout):
            member.error = f"no answer in {timeout:.0f} s"
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
                arrival = (
                    member.pose_arrived if kind is POSE_BLOCK else member.body_arrived
                )
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
            if all(
                len(set(m.phases.values())) == self._body_logs for m in self.members
            ):
                break

    def _start_in_step(self):
        """All poses at the same moment, the blocks of motors spread evenly over the 10
        ms.
        """
        begin = perf_counter() + 0.01
        for number in range(1 + self._body_logs):
            due = (
                begin + 1e-3 * PERIOD_MS * (number - 0.5) / self._body_logs
                if number
                else begin
            )
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
        """What is known of each vehicle."""
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

    def record(self) -> None:
        """Keep all samples from now on."""
        for member in self.members:
            member.recording = True

    def samples(self) -> list[tuple[bytes, bytes]]:
        """What was recorded of each vehicle until now: poses and bodies, rows of
        float64 as in `Samples`.
        """
        return [
            (member.poses.tobytes(), member.bodies.tobytes()) for member in self.members
        ]

    def close(self) -> None:
        """Motors off, disarmed, links closed."""
        self.arm(False)
        for member in self.members:
            if member.crazyflie is not None:
                # the link is gone already
                with contextlib.suppress(OSError, struct.error):
                    member.crazyflie.close_link()
                member.crazyflie = None

"""One vehicle of the swarm: what its log blocks tell."""

import math
from collections.abc import Callable
from time import perf_counter

from openjax.flying.controller import Pose, numbers_of
from openjax.flying.crtp import expand_quaternion
from openjax.flying.onboard_clock import OnboardClock
from openjax.flying.record_pipe import RecordKind
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
    # with the motors that answer it: a gyroscope logged at 100 Hz hides what they do
    *((f"gyro.{v}", "FP16") for v in "xyz"),
)


class SwarmMember:
    """One vehicle of the swarm."""

    def __init__(self, uri: str):
        self.uri = uri
        self._onboard = OnboardClock()
        self.pose: Pose | None = None
        self.arrival = -math.inf  # host s, of the newest pose
        self.last_contact = perf_counter()
        self.voltage = math.nan
        self.supervisor = 0
        # host s, the newest specific force (m/s^2, body)
        self.felt: tuple = (-math.inf, None)
        self.error: str | None = None
        # rows as in `openjax.flying.flight_files.VehicleSamples`
        self.tell: Callable[[RecordKind, tuple[float, ...]], None] = lambda kind, row: None
        self.listener: Callable[[bool], None] = lambda new_pose: None
        self.crazyflie = None
        self.blocks: list = []
        # when in the period each block of motors was sampled last (ms)
        self.phases: dict = {}

    def sample(self) -> PoseSample:
        """The latest sample of the vehicle."""
        is_recent = self.pose is not None and abs(self.pose.time - self.felt[0]) <= FORCE_AGE
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
        # in millimetres, mm/s, degrees/s and millivolts, so that all fits into one packet
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
        self.tell(RecordKind.POSES, (arrival, self.voltage, *numbers_of(pose)))
        self.listener(True)

    def body_arrived(self, stamp: int, data: dict, _block=None) -> None:
        """A block of motors, accelerometer and gyroscope."""
        arrival = perf_counter()
        self.last_contact = arrival
        self.phases[_block] = stamp % PERIOD_MS
        time = self._onboard.host(stamp, arrival)
        # the accelerometer counts in g, the gyroscope in degrees
        force = tuple(9.81 * data[name] for name, _ in BODY_BLOCK[4:7])
        rates = tuple(math.radians(data[name]) for name, _ in BODY_BLOCK[7:])
        if time > self.felt[0]:  # packets may overtake each other
            self.felt = time, force
        motors = tuple(data[name] / 65536 for name, _ in BODY_BLOCK[:4])
        self.tell(RecordKind.BODIES, (time, *motors, *force, *rates))
        self.listener(False)

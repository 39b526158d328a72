"""The state of a flight's vehicles: limits, modes, requests, samples of poses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, NamedTuple

from openjax.flying.controller import Airframe, Pose, Vector, nominal_airframe
from openjax.flying.crtp import Supervisor
from openjax.flying.judge import PoseLimits
from openjax.flying.set_point import MOTORS_OFF, SetPoint
from openjax.flying.sources import PoseSource
from openjax.ranges import Interval, check_intervals
from openjax.vehicle.arena import Arena

SPIN_UP = 0.3
"""A vehicle that lifts off may stand still for so long (s)."""
FORCE_AGE = 0.025
"""An accelerometer's sample tells of a pose that was measured no longer (s) before or after it."""
_NOTHING_SEEN = PoseSource()


@dataclass(frozen=True)
class SafetySettings:
    """Limits of a flight."""

    arena_radius: Annotated[float, Interval("[0.3, 1000]")] = Arena.radius
    """No vehicle is let out of a cylinder of this radius (m)."""
    arena_height: Annotated[float, Interval("[0.6, 1000]")] = Arena.height
    """No vehicle is let out above this height (m)."""
    floor: Annotated[float, Interval("[0, 100]")] = 0.12
    """No vehicle in pursuit is let below this height (m)."""
    outside: Annotated[float, Interval("[0, 100]")] = 0.3
    """Farther out of the arena than this (m) something is wrong: all land."""
    separation: Annotated[float, Interval("[0, 10]")] = 0.16
    """Vehicles in pursuit that couldn't stop at this distance (m) any more brake and
    part. 0 switches it off.
    """
    speed_limit: Annotated[float, Interval("(0, 100]")] = 2.5
    """Faster than this (m/s) something is wrong: all land."""
    tilt_limit: Annotated[float, Interval("(0, 180]")] = 50.0
    """More tilted than this (degrees) something is wrong: all land."""
    tumble_time: Annotated[float, Interval("[0, 10]")] = 0.1
    """Upside down for longer (s): motors off."""
    braking: Annotated[float, Interval("(0, 100]")] = 5.0
    """Deceleration that is counted on to stop within the arena (m/s^2)."""
    reaction: Annotated[float, Interval("(0, 10]")] = 0.12
    """Time constant with which the acceleration follows what is asked for (s)."""
    pose_timeout: Annotated[float, Interval("(0, 60]")] = 0.06
    """Without a good pose for longer (s) a vehicle is flown by reckoning no more: it lands."""
    link_timeout: Annotated[float, Interval("(0, 60]")] = 0.3
    """A link silent for longer (s) is gone."""
    alone_time: Annotated[float, Interval("(0, 1e9]")] = 40.0
    """All land after so long in the air by the vehicles' own estimates alone (s):
    nothing tells a slow drift of theirs.
    """
    action_timeout: Annotated[float, Interval("(0, 60]")] = 0.035
    """Without a new action of the policy for longer (s): all stop where they are."""
    battery_low: Annotated[float, Interval("[0, 100]")] = 3.2
    """Voltage under load at which a vehicle lands (V), if it is as low for `battery_time`."""
    battery_time: Annotated[float, Interval("[0, 60]")] = 0.5
    """Time for which the voltage must be low (s): a sudden climb takes it down for a moment."""
    battery_start: Annotated[float, Interval("[0, 100]")] = 3.7
    """No vehicle takes off with less, measured without load (V)."""
    stand: Annotated[float, Interval("(0, 1000]")] = 0.15
    """No vehicle takes off farther than this (m) from below its start."""
    lift: Annotated[float, Interval("(0, 1]")] = 0.1
    """Height of the test lift (m)."""
    lift_time: Annotated[float, Interval("(0, 60]")] = 2.0
    """The test lift must be done within this time (s)."""
    hold_time: Annotated[float, Interval("[0, 600]")] = 0.5
    """Time that vehicles wait after a trouble before they land (s)."""
    transfer_speed: Annotated[float, Interval("(0, 10]")] = 0.5
    """Speed on the way to the start (m/s)."""
    landing_speed: Annotated[float, Interval("(0, 10]")] = 0.4
    """Speed at which vehicles come down (m/s)."""

    def __post_init__(self):
        check_intervals(self, "safety.")

    @property
    def landing_time(self) -> float:
        """A landing that takes longer (s) ends with the motors off: by then a vehicle that began at
        the highest place that is allowed is near the floor, whatever its pose says.
        """
        return (self.arena_height + self.outside) / self.landing_speed


class Mode(StrEnum):
    """The control of a vehicle: by whom, and to what end."""

    GROUND = "ground"
    LIFT = "test lift"  # a hand's breadth, to see that poses rise as they should
    TRANSFER = "transfer"  # the way to where it is to start
    READY = "ready"
    PURSUIT = "pursuit"
    HOLD = "hold"
    LAND = "land"
    SETTLE = "settling"  # the last of a landing
    LANDED = "landed"
    STOPPED = "stopped"


LANDING = (Mode.LAND, Mode.SETTLE)
FLYING = (Mode.LIFT, Mode.TRANSFER, Mode.READY, Mode.PURSUIT, Mode.HOLD, *LANDING)


class Request(StrEnum):
    """A request of the operator or the flight plan."""

    NONE = ""
    TRANSFER = "transfer"
    PURSUE = "pursue"
    HOLD = "hold"
    LAND = "land"
    STOP = "stop"


class PoseSample(NamedTuple):
    """The latest sample of one vehicle at a tick, however old."""

    own: Pose | None
    """The newest estimate of the vehicle itself."""
    last_contact: float
    """Time of its link's last message (s)."""
    voltage: float = math.nan
    supervisor: int = Supervisor.ARMED | Supervisor.CAN_FLY
    """The firmware's word on its state."""
    captured: Pose | None = None
    """The newest of motion capture, whose velocity and body rates mean nothing; None
    where there is no motion capture.
    """
    force: Vector | None = None
    """The newest specific force of its accelerometer (m/s^2, body), measured within
    `FORCE_AGE` of its own estimate; None where none is logged.
    """


class Event(NamedTuple):
    """One tick."""

    time: float
    samples: tuple[PoseSample, ...]
    actions: tuple[SetPoint, ...] | None = None
    """The policy's set-points, if they came with this tick."""
    request: Request = Request.NONE
    reason: str = ""
    """Why it is requested, where nobody asked."""


class Drone(NamedTuple):
    """One vehicle's part of the state."""

    mode: Mode = Mode.GROUND
    since: float = 0.0  # s, when the mode began
    # where it is now: the newest pose, moved on to this tick
    estimate: Pose | None = None
    own: PoseSource = _NOTHING_SEEN  # its own estimates
    captured: PoseSource = _NOTHING_SEEN  # motion capture, with velocity and rates
    # whether the estimator on board is to follow the newest of it
    feeds_estimator: bool = True
    seen: float = -math.inf  # s, when the pose that it is flown by was measured
    # own and captured position before the lift, where there is one
    stand: tuple[Vector | None, Vector | None] = (None, None)
    acceleration: Vector = (0.0, 0.0, 0.0)  # m/s^2, what dead reckoning takes it to be
    anchor: Vector = (0.0, 0.0, 0.0)  # where it waits or lands
    trim: float = 0.0  # of the hover thrust
    # s, when its own estimate became all that there is
    alone_since: float | None = None
    low_since: float | None = None  # battery
    over_since: float | None = None  # upside down
    reason: str = ""  # why it left the pursuit
    sent: SetPoint = MOTORS_OFF

    def to(
        self, mode: Mode, time: float, anchor: Vector | None = None, reason: str = ""
    ) -> "Drone":
        """The drone in another mode from `time` (s) on; anchor and reason stay what
        they were unless given.
        """
        return self._replace(
            mode=mode,
            since=time,
            anchor=self.anchor if anchor is None else anchor,
            reason=reason or self.reason,
        )


class State(NamedTuple):
    """The state machine's state."""

    drones: tuple[Drone, ...]
    starts: tuple[Vector, ...]
    settings: SafetySettings
    limits: PoseLimits
    airframe: Airframe
    pillars: tuple[tuple[float, float, float], ...] = ()  # x, y, radius (m)
    time: float = 0.0
    dt: float = 0.0
    action_time: float = 0.0

    @property
    def flying(self) -> bool:
        """True if any motor may be on."""
        return any(drone.mode in FLYING for drone in self.drones)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The modes of all vehicles."""
        return tuple(drone.mode for drone in self.drones)

    def all_in(self, *modes: Mode) -> bool:
        """True if every vehicle is in one of these modes."""
        return all(drone.mode in modes for drone in self.drones)


def initial_state(
    starts: Sequence[Vector],
    pillars: Sequence[Vector] = (),
    airframe: Airframe | None = None,
    settings: SafetySettings | None = None,
) -> State:
    """All vehicles on the ground; they are to start at `starts` (m); pillars are x, y, radius."""
    airframe = airframe or nominal_airframe()
    settings = settings or SafetySettings()
    limits = PoseLimits(
        airframe.acceleration, airframe.angular_acceleration, horizon=settings.pose_timeout
    )
    drones = tuple(Drone() for _ in starts)
    return State(
        drones=drones,
        starts=tuple(starts),
        settings=settings,
        limits=limits,
        airframe=airframe,
        pillars=tuple(pillars),
    )

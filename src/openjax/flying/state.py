"""What is known and wanted of the vehicles of a flight: modes, requests, samples of poses, and the
state of all.
"""

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

from openjax.flying.controller import Airframe, Pose, Vector, nominal_airframe
from openjax.flying.crtp import Supervisor
from openjax.flying.judge import PoseLimits, Track, pose_limits
from openjax.flying.limits import SafetySettings, resting_places
from openjax.flying.set_point import MOTORS_OFF, SetPoint

SPIN_UP = 0.3
"""A vehicle that lifts off may stand still for so long (s)."""
_NOTHING_SEEN = Track()


class Mode(StrEnum):
    """Who flies a vehicle, and what it does."""

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
    """What the operator or the flight plan asks for."""

    NONE = ""
    TRANSFER = "transfer"
    PURSUE = "pursue"
    HOLD = "hold"
    LAND = "land"
    STOP = "stop"


class PoseSample(NamedTuple):
    """What is known of one vehicle at a tick, however old."""

    own: Pose | None
    """The newest estimate of the vehicle itself."""
    last_contact: float
    """When its link last said anything (s)."""
    voltage: float = math.nan
    supervisor: int = Supervisor.ARMED | Supervisor.CAN_FLY
    """The firmware's word on its state."""
    captured: Pose | None = None
    """The newest of motion capture, whose velocity and body rates mean nothing; None where there is
    no motion capture.
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
    estimate: Pose | None = None  # now; reckoned on where no pose is fresh
    own: Track = _NOTHING_SEEN  # its own estimates
    captured: Track = _NOTHING_SEEN  # motion capture, with velocity and rates
    told: bool = True  # whether the estimator on board is to follow the newest of it
    seen: float = -math.inf  # s, when the pose that it is flown by was measured
    distrusted: str = ""  # why motion capture isn't believed any more in this flight
    stand: tuple[Vector | None, Vector | None] = (
        None,
        None,
    )  # own and captured position before the lift
    acceleration: Vector = (0.0, 0.0, 0.0)  # m/s^2, what dead reckoning takes it to be
    anchor: Vector = (0.0, 0.0, 0.0)  # where it waits or lands
    trim: float = 0.0  # of the hover thrust
    low_since: float | None = None  # battery
    over_since: float | None = None  # upside down
    reason: str = ""  # why it left the pursuit
    sent: SetPoint = MOTORS_OFF

    def to(self, mode: Mode, now: float, anchor: Vector | None = None, reason: str = "") -> "Drone":
        """The drone in another mode from `now` (s) on; anchor and reason stay what they were unless
        given.
        """
        return self._replace(
            mode=mode,
            since=now,
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
        """Whether any motor may be on."""
        return any(drone.mode in FLYING for drone in self.drones)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Of all vehicles."""
        return tuple(drone.mode for drone in self.drones)

    def all_in(self, *modes: Mode) -> bool:
        """Whether every vehicle is in one of these modes."""
        return all(drone.mode in modes for drone in self.drones)

    def resting_places(self) -> list[Vector]:
        """Where the vehicles may wait or land (m); see `openjax.flying.limits.resting_places`."""
        return resting_places(
            self.settings, self.pillars, [drone.estimate for drone in self.drones]
        )


def initial_state(
    starts: Sequence[Vector],
    pillars: Sequence[Vector] = (),
    airframe: Airframe | None = None,
    settings: SafetySettings | None = None,
) -> State:
    """All vehicles on the ground; they are to start at `starts` (m); pillars are x, y, radius."""
    airframe = airframe or nominal_airframe()
    settings = settings or SafetySettings()
    limits = pose_limits(airframe, settings.pose_timeout)
    drones = tuple(Drone() for _ in starts)
    return State(drones, tuple(starts), settings, limits, airframe, tuple(pillars))

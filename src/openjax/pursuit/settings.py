"""Settings of the game: arena, vehicles' limits, evader, observation and reward."""

from dataclasses import dataclass, field
from typing import Literal

from openjax.errors import UserError
from openjax.vehicle.family import check_ranges

HIDDEN = -5.0
"""What stands in an observation for something that isn't seen (the paper's marker value)."""

OWN_FRAME = 13
"""Numbers in a frame of the own history: velocity, body x and z axes, command."""

SOLID_RADIUS = 0.05
"""Radius (m) of the sphere that makes a drone solid."""


@dataclass(frozen=True)
class RewardSettings:
    """Weights of the reward. Paper, section IV-A; the speed penalty is the released code's, at the collision's weight."""

    capture: float = 6.0
    """To every pursuer, in each step in which any pursuer captures."""
    distance: float = 0.1
    """Subtracted per metre between pursuer and evader."""
    collision: float = 10.0
    """Subtracted per breach of a safety distance or an arena bound."""
    over_speed: float = 10.0
    """Subtracted in each step above 1.01 times the maximal speed."""
    smoothness: float = 0.0
    """Weight of exp(-|a_t - a_{t-1}|); 2.0 in the paper's second stage."""
    crash: float = 0.0
    """Subtracted in each step in which a pursuer touches something solid or tips over (not in the paper)."""
    first_crash: float = 0.0
    """Subtracted once, of the pursuers that crash first in an episode, and not early by margin or lookahead: while they
    count a start close to a pillar as a crash anyhow, nothing else would be lost by touching it (not in the paper)."""
    margin: float = 0.0
    """The reward counts breaches, floor and tilt (as a cosine) this much early; the metrics don't (m; not in the paper)."""
    lookahead: float = 0.0
    """The reward also counts the breaches that come within this time at the present velocities (s; not in the paper)."""


@dataclass(frozen=True)
class PursuitSettings:
    """The pursuit-evasion game. Lengths in metres, times in seconds; numbers of the paper unless said otherwise."""

    num_pursuers: int = 3
    """Number of pursuing quadrotors, 1 to 8."""
    min_pillars: int = 4
    """Fewest pillars of a uniform task."""
    max_pillars: int = 5
    """Most pillars of a uniform task; also the number of pillar slots of a task."""
    arena_radius: float = 0.9
    arena_height: float = 1.2
    pillar_radius: float = 0.1
    capture_radius: float = 0.3
    evader_speed: float = 1.3
    """Speed of the evader (m/s)."""
    evader_norm: Literal["euclidean", "axis"] = "euclidean"
    """How the evader's force becomes a velocity; "axis" normalises by the largest component (up to 3**0.5 faster)."""
    max_speed: float = 1.0
    """Maximal speed of a pursuer (m/s)."""
    speed_limit: Literal["clamp", "none"] = "clamp"
    """"clamp": the velocity's norm is cut after each step, as in the paper's simulator; "none": honest physics."""
    pillar_clearance: float = 0.07
    """A drone's centre closer than this to a pillar's surface is a collision."""
    drone_clearance: float = 0.14
    """Two drones' centres closer than this are a collision."""
    start_attitude: Literal["drawn", "level"] = "drawn"
    """"drawn": roll, pitch within 36 degrees, yaw in 0 to 36 degrees; "level": identity."""
    episode_length: int = 800
    """Control steps per episode."""
    time_step: float = 0.01
    """Control step (s)."""
    substeps: int = 1
    """Physics (and rate controller) steps per control step."""
    physics: Literal["mjx", "rigid", "stops"] = "mjx"
    """"mjx": MuJoCo MJX, the reference; "rigid": the same equations written out, contacts included, many times faster;
    "stops": free flight, and drones are put back out of floor, pillars and one another once per control step."""
    contacts: bool = True
    """Floor, pillars and other drones are solid; False: free flight, in which nothing is touched."""
    vehicles: tuple[tuple[str, float, float, float, float], ...] = ()
    """Family from which every pursuer's vehicle is drawn in each episode: parameters of effects (`motor_lag.extra_up`), each
    with its range and the wider range of the rare; see `openjax.vehicle.family`. Empty: the nominal vehicle."""
    rare_vehicles: float = 0.0
    """Share of the vehicles of which one effect is drawn from its wider range."""
    observed_pillars: int = 3
    """Nearest pillars that a pursuer observes."""
    observe_time: bool = True
    """Observe t/T; then the end of an episode is terminal, otherwise it is a truncation."""
    observe_position: bool = False
    """Also observe the own position in the arena (not in the paper, where the arena's bounds stay unseen)."""
    observe_history: int = 0
    """Also observe this many of the last frames of the own velocity, attitude and command (not in the paper): they show how
    this vehicle answers, and which commands are still on their way."""
    observe_history_spacing: int = 1
    """Control steps between two of these frames."""
    history_length: int = 10
    """Frames that the evader predictor sees."""
    history_spacing: int = 1
    """Control steps between two frames of the history."""
    reward: RewardSettings = field(default_factory=RewardSettings)

    def __post_init__(self):
        def need(condition, text):
            if not condition:
                raise UserError(f"environment: {text}")

        need(1 <= self.num_pursuers <= 8, f"num_pursuers is {self.num_pursuers}; 1 to 8 are possible")
        need(
            0 <= self.min_pillars <= self.max_pillars,
            f"min_pillars {self.min_pillars} must lie between 0 and max_pillars {self.max_pillars}",
        )
        need(self.episode_length >= 1, f"episode_length is {self.episode_length}; it must be at least 1")
        need(self.substeps >= 1, f"substeps is {self.substeps}; it must be at least 1")
        need(
            self.observed_pillars >= 1, f"observed_pillars is {self.observed_pillars}; it must be at least 1"
        )
        need(self.history_length >= 1, f"history_length is {self.history_length}; it must be at least 1")
        need(self.history_spacing >= 1, f"history_spacing is {self.history_spacing}; it must be at least 1")
        need(self.observe_history >= 0, f"observe_history is {self.observe_history}; it can't be negative")
        need(
            self.observe_history_spacing >= 1,
            f"observe_history_spacing is {self.observe_history_spacing}; it must be at least 1",
        )
        need(
            0.0 <= self.rare_vehicles <= 1.0, f"rare_vehicles is {self.rare_vehicles}; it must lie in 0 to 1"
        )
        check_ranges(self.vehicles)
        for name in (
            "arena_radius",
            "arena_height",
            "pillar_radius",
            "capture_radius",
            "evader_speed",
            "max_speed",
            "time_step",
        ):
            need(getattr(self, name) > 0, f"{name} is {getattr(self, name)}; it must be positive")

    @property
    def middle(self) -> tuple[float, float, float]:
        """The arena's middle (m), where the evader is taken to be until it is first seen."""
        return (0.0, 0.0, self.arena_height / 2)

    @property
    def frame_size(self) -> int:
        """Numbers in one frame of the history: time, evader position and velocity, pursuer positions."""
        return 1 + 3 + 3 + 3 * self.num_pursuers

    @property
    def self_size(self) -> int:
        """Numbers of a pursuer's own part of the observation, without the predicted positions."""
        own = 3 + 4 + 3 + 3 + 3 + (4 if self.observe_time else 0) + (3 if self.observe_position else 0)
        return own + OWN_FRAME * self.observe_history

    @property
    def privileged_size(self) -> int:
        """Numbers of the privileged part of the observation, for the critic."""
        return 3 + 3 + 3 + 1 + (3 + len(self.vehicles) if self.vehicles else 0)

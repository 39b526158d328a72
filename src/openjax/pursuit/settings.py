"""Settings of the game: arena, vehicles' limits, evader, observation and reward."""

import dataclasses
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Literal

from openjax.errors import UserError
from openjax.pursuit.evaders.kinds import check_evaders
from openjax.ranges import Interval, check_intervals
from openjax.vehicle.arena import Arena

HIDDEN = -5.0
"""What stands in an observation for something that isn't seen (the paper's marker
value).
"""

OWN_FRAME = 13
"""Numbers in a frame of the own history: velocity, body x and z axes, command."""

LAYOUT_PURSUERS = 3
"""Pursuers of the six layouts, and so of a policy for teams of any size by default."""

OBSERVED = (
    *("observed_pillars", "observe_time", "observe_position", "observe_game"),
    *("observe_arena", "observe_in", "observe_history"),
    *("history_length", "history_spacing", "history_pursuers"),
    *("track_unseen", "strategies", "strategy_seconds"),
)
"""The settings that say what a pursuer observes; all others are the game's."""


@dataclass(frozen=True)
class RewardSettings:
    """Weights of the reward. Paper, section IV-A; the speed penalty is the released
    code's, at the collision's weight.
    """

    CAPTURE = 6.0
    """To every pursuer, in each step in which any pursuer captures."""
    first_capture: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """To every pursuer, once, at an episode's first capture: where the evader gets away
    again, a step in reach of it is worth less than closing in costs (not in the paper).
    """
    recapture: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """The same for each later capture of an evader that was free for a second: most
    steps of a training come after a capture, and who can't tell learns that there is
    little to win (not in the paper).
    """
    distance: Annotated[float, Interval("[0, 1e6]")] = 0.1
    """Subtracted per metre between pursuer and evader."""
    path: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """Subtracted per metre of the shortest path round the pillars between pursuer and
    evader: who minds the straight line alone waits behind a wall, opposite to the
    evader (not in the paper).
    """
    unseen: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """Subtracted, of all pursuers, in each step in which nobody sees the evader: in a
    notch between two pillars it is safe from a team that waits all round and doesn't
    look in (not in the paper).
    """
    collision: Annotated[float, Interval("[0, 1e6]")] = 10.0
    """Subtracted per breach of a safety distance or an arena bound."""
    OVER_SPEED = 10.0
    """Subtracted in each step above 1.01 times the maximal speed."""
    smoothness: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """Weight of `exp(-|a_t - a_{t-1}|)`; 2.0 in the paper's second stage."""
    crash: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """Subtracted in each step in which a pursuer touches something solid or tips over
    (not in the paper).
    """
    first_crash: Annotated[float, Interval("[0, 1e6]")] = 0.0
    """Subtracted once, of the pursuers that crash first in an episode, and not early by
    margin or lookahead: while they count a start close to a pillar as a crash anyhow,
    nothing else would be lost by touching it (not in the paper).
    """
    margin: Annotated[float, Interval("[0, 1]")] = 0.0
    """The reward counts breaches, floor and tilt (as a cosine) this much early; the
    metrics don't (m; not in the paper).
    """
    lookahead: Annotated[float, Interval("[0, 10]")] = 0.0
    """The reward also counts the breaches that come within this time at the present
    velocities (s; not in the paper).
    """

    FORMER = MappingProxyType({"nearest": 0.0, "territory": 0.0})
    """Terms that earlier versions had, and their only weight now."""

    def __post_init__(self):
        check_intervals(self, "environment.reward.")

    @property
    def needs_paths(self) -> bool:
        """True if worlds have to know the shortest paths round their pillars."""
        return self.path != 0.0


@dataclass(frozen=True)
class PursuitSettings:
    """The pursuit-evasion game. Lengths in metres, times in seconds; numbers of the
    paper unless said otherwise.
    """

    num_pursuers: Annotated[int, Interval("[1, 8]")] = 3
    """Number of pursuing quadrotors, 1 to 8; with `team_sizes` the number of slots for
    them.
    """
    team_sizes: Annotated[tuple[int, ...], Interval("[1, 8]")] = ()
    """Sizes of teams, one of which is drawn for each uniform task with equal odds; the
    other slots for pursuers stay empty. Empty: all are in use.
    """
    min_pillars: Annotated[int, Interval("[0, 32]")] = 4
    """Fewest pillars of a uniform task."""
    max_pillars: Annotated[int, Interval("[0, 32]")] = 5
    """Most pillars of a uniform task; also the number of pillar slots of a task."""
    arena_radius: Annotated[float, Interval("[0.1, 100]")] = 0.9
    """Of the cylinder that nobody may leave (m)."""
    arena_radii: Annotated[tuple[float, ...], Interval("[0.1, 100]")] = ()
    """Smallest and largest radius of the arena (m), between which that of each uniform
    task is drawn, in place of `arena_radius`; empty: none is drawn. Starts and pillars
    lie wider apart in a wider one.
    """
    arena_height: Annotated[float, Interval("[0.3, 100]")] = 1.2
    """Of that cylinder, and of the pillars (m)."""
    pillar_radius: Annotated[float, Interval("[0.001, 10]")] = 0.1
    """Of each pillar (m)."""
    capture_radius: Annotated[float, Interval("(0, 10]")] = 0.3
    """The evader is captured while a pursuer is nearer than this (m)."""
    evader_speed: Annotated[float, Interval("(0, 100]")] = 1.3
    """Speed of the evader (m/s)."""
    evader_speeds: Annotated[tuple[float, ...], Interval("(0, 100]")] = ()
    """Lowest and highest speed of the evader (m/s), between which that of each uniform
    task is drawn, in place of `evader_speed`; empty: none is drawn.
    """
    fall_outs: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the episodes of two or more pursuers in which one of them falls out, and
    is gone.
    """
    fall_out_seconds: Annotated[tuple[float, ...], Interval("[0, 1000]")] = (0.5, 4.0)
    """Earliest and latest time at which a pursuer falls out (s)."""
    capture_radii: Annotated[tuple[float, ...], Interval("(0, 10]")] = ()
    """Smallest and largest capture radius (m), the same in place of
    `capture_radius`.
    """
    sight_range: Annotated[float, Interval("(0, 1000]")] = 1000.0
    """Distance (m) up to which a pursuer sees the evader, if no pillar is between (not
    in the paper). It limits neither captures nor what the evader sees.
    """
    sight_angle: Annotated[float, Interval("(0, 360]")] = 360.0
    """Angle (degrees) by which the cone opens about a pursuer's body x axis in which it
    sees the evader, if no pillar is between (not in the paper). It limits neither
    captures nor what the evader sees.
    """
    evaders: tuple[str, ...] = ("field",)
    """Evaders, one of which is drawn for each episode with equal odds; a name that
    comes twice is drawn twice as often. "field" is the paper's; each "learned" is a
    network of its own, which learns while the pursuers do; see
    `openjax.pursuit.evaders`.
    """
    max_speed: Annotated[float, Interval("(0, 100]")] = 1.0
    """Maximal speed of a pursuer (m/s)."""
    speed_limit: Literal["clamp", "none"] = "clamp"
    """"clamp": the velocity's norm is cut after each step, as in the paper's simulator;
    "none": honest physics.
    """
    pillar_clearance: Annotated[float, Interval("[0, 10]")] = 0.07
    """A drone's centre closer than this to a pillar's surface is a collision."""
    drone_clearance: Annotated[float, Interval("[0, 10]")] = 0.14
    """Two drones' centres closer than this are a collision."""
    start_attitude: Literal["drawn", "level"] = "drawn"
    """"drawn": roll, pitch within 36 degrees, yaw in 0 to 36 degrees; "level":
    identity.
    """
    episode_length: Annotated[int, Interval("[1, 100000]")] = 800
    """Control steps per episode."""
    time_step: Annotated[float, Interval("[0.0001, 0.1]")] = 0.01
    """Control step (s)."""
    substeps: Annotated[int, Interval("[1, 100]")] = 1
    """Physics (and rate controller) steps per control step."""
    physics: Literal["rigid", "mjx", "stops"] = "rigid"
    """"rigid": MuJoCo's equations written out, contacts included; "mjx": MuJoCo MJX,
    the reference, many times slower; "stops": free flight, and drones are put back out
    of floor, pillars and one another once per control step.
    """
    contacts: bool = True
    """Floor, pillars and other drones are solid; False: free flight, in which nothing
    is touched.
    """
    airframe: str = "crazyflie"
    """The nominal vehicle: "crazyflie" is the Crazyflie 2.1, "brushless" the Crazyflie
    2.1 Brushless; others after `openjax.vehicle.register_airframe`.
    """
    vehicles: tuple[tuple[str, float, float, float, float], ...] = ()
    """Family from which every pursuer's vehicle is drawn in each episode: parameters of
    effects (`motor_lag.extra_up`), each with its range and the wider range of the rare;
    see `openjax.vehicle.family`. Empty: the nominal vehicle.
    """
    rare_vehicles: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the vehicles of which one effect is drawn from its wider range."""
    observed_pillars: Annotated[int, Interval("[1, 32]")] = 3
    """Nearest pillars that a pursuer observes."""
    observe_time: bool = True
    """Observe t/T; then the end of an episode is terminal, otherwise it is a
    truncation.
    """
    observe_position: bool = False
    """Also observe the own position in the arena (not in the paper, where the arena's
    bounds stay unseen).
    """
    observe_game: bool = False
    """Also observe the evader's speed, as a multiple of the pursuers', and the capture
    radius in m (not in the paper, where both are the same in all games).
    """
    observe_arena: bool = False
    """Also observe the arena's radius in m (not in the paper, where all games have the
    same).
    """
    observe_in: Literal["world", "heading"] = "world"
    """Axes of what a pursuer observes. "heading": its own, but upright: a game turned
    about the arena's axis looks the same, at any yaw (not in the paper).
    """
    track_unseen: bool = False
    """Take an evader that nobody sees to be at the hidden place nearest to where it was
    thought to be (not in the paper, where it stays where it was last seen): who sees
    that place, and nothing there, has to look elsewhere. See `openjax.pursuit.hiding`.
    """
    strategies: Annotated[int, Interval("[1, 16]")] = 1
    """Strategies, one of which the team draws at an episode's start without telling the
    evader (a mixed strategy; not in the paper). More than one is for policies of so
    many members: `openjax.policy.MixedPolicy`.
    """
    strategy_odds: Annotated[tuple[float, ...], Interval("[0, 1000]")] = ()
    """Odds of each strategy, in any unit; empty: all have the same."""
    strategy_odds_unseen: Annotated[tuple[float, ...], Interval("[0, 1000]")] = ()
    """The same while nobody sees the evader; empty: as while somebody does."""
    strategy_seconds: Annotated[float, Interval("[0, 1000]")] = 0.0
    """Time after which the team draws again (s); 0: never."""
    observe_history: Annotated[int, Interval("[0, 1000]")] = 0
    """Also observe this many of the last frames of the own velocity, attitude and
    command (not in the paper): they show how this vehicle answers, and which commands
    are still on their way.
    """
    history_length: Annotated[int, Interval("[1, 1000]")] = 10
    """Frames that the evader predictor sees."""
    history_spacing: Annotated[int, Interval("[1, 1000]")] = 1
    """Control steps between two frames of either history."""
    history_pursuers: Literal["each", "pooled", "both"] = "each"
    """The part of the pursuers that these frames hold. "each": all positions, as in the paper;
    "pooled": where the nearest one is and whence all press, for teams of any size;
    "both": for a team of policies of both kinds.
    """
    reward: RewardSettings = field(default_factory=RewardSettings)

    FORMER = MappingProxyType({"evader_norm": "euclidean", "observe_history_spacing": 1})
    """Settings that earlier versions had, and their only value now."""

    def __post_init__(self):
        check_intervals(self, "environment.")
        self._check_numbers()
        if self.airframe != PursuitSettings.airframe:
            # only here: settings alone needn't wait for MuJoCo
            from openjax.vehicle.parameters import check_airframe

            check_airframe(self.airframe)
        if self.vehicles:
            # only here: it knows the effects, which are written in JAX
            from openjax.vehicle.family import checked_ranges

            # files and Python hand in plain tuples; from here on their numbers have
            # names
            object.__setattr__(self, "vehicles", checked_ranges(self.vehicles))
        check_evaders(self.evaders)

    def _check_numbers(self):
        """Raise UserError for numbers that exclude each other."""
        if self.min_pillars > self.max_pillars:
            raise UserError(
                f"environment.min_pillars {self.min_pillars} is more than environment.max_pillars "
                f"{self.max_pillars}"
            )
        # somewhere beside a pillar a pursuer must have room
        most = self.arena_radius - self.pillar_clearance
        if self.max_pillars and self.pillar_radius >= most:
            raise UserError(
                f"environment.pillar_radius {self.pillar_radius} leaves no room in an arena of "
                f"radius {self.arena_radius}: less than {most:.3g} would be right, or "
                "environment.max_pillars 0"
            )
        if self.team_sizes and max(self.team_sizes) > self.num_pursuers:
            raise UserError(
                f"environment.team_sizes {list(self.team_sizes)} need environment.num_pursuers "
                f"{max(self.team_sizes)}, here it's {self.num_pursuers}"
            )
        for name in ("strategy_odds", "strategy_odds_unseen"):
            odds = getattr(self, name)
            if odds and (len(odds) != self.strategies or not sum(odds)):
                raise UserError(
                    f"environment.{name} {list(odds)} must be one number for each of the "
                    f"{self.strategies} strategies, not all of them zero"
                )
        spans = ("evader_speeds", "capture_radii", "arena_radii", "fall_out_seconds")
        for name in spans:
            # none at all is fine, but for the seconds of those that fall out
            drawn_from = getattr(self, name)
            is_needed = name == "fall_out_seconds" and self.fall_outs
            if (drawn_from or is_needed) and (
                len(drawn_from) != 2 or drawn_from[0] > drawn_from[1]
            ):
                raise UserError(
                    f"environment.{name} {list(drawn_from)} must be two numbers, the "
                    "lower one first, "
                    "or none"
                )

    def of_one_team(self, number: int) -> "PursuitSettings":
        """The same game with one size of team, of which nobody falls out, one speed of
        the evader, one capture radius and one arena.
        """
        names = ("team_sizes", "evader_speeds", "capture_radii", "arena_radii")
        return dataclasses.replace(
            self, num_pursuers=number, fall_outs=0.0, **dict.fromkeys(names, ())
        )

    def observed_as(self, other: "PursuitSettings") -> "PursuitSettings":
        """The same game as pursuers observe it who learned in another one."""
        return dataclasses.replace(self, **{name: getattr(other, name) for name in OBSERVED})

    @property
    def strategy_steps(self) -> int:
        """Control steps between two draws of a strategy."""
        if not self.strategy_seconds:
            return self.episode_length
        return max(1, round(self.strategy_seconds / self.time_step))

    @property
    def limited_sight(self) -> bool:
        """True if something else than pillars can hide the evader."""
        full_sight = PursuitSettings.sight_range, PursuitSettings.sight_angle
        return (self.sight_range, self.sight_angle) != full_sight

    @property
    def arena(self) -> Arena:
        """The sizes that vehicles, effects and pictures need."""
        return Arena(self.arena_radius, self.arena_height, self.pillar_radius)

    @property
    def middle(self) -> tuple[float, float, float]:
        """The arena's middle (m), where the evader is taken to be until it is first
        seen.
        """
        return (0.0, 0.0, self.arena_height / 2)

    @property
    def frame_size(self) -> int:
        """Numbers in one frame of the history: time, evader position and velocity,
        pursuer positions, or what is pooled of them.
        """
        pursuers = {"each": self.num_pursuers, "pooled": 2, "both": self.num_pursuers + 2}
        return 1 + 3 + 3 + 3 * pursuers[self.history_pursuers]

    @property
    def self_size(self) -> int:
        """Numbers of a pursuer's own part of the observation, without the predicted
        positions.
        """
        # in the order of `Observation.self_state`: evader, quaternion, velocity, two
        # axes, time, position, the game's numbers, the arena, history
        base = 3 + 4 + 3 + 3 + 3
        time = 4 if self.observe_time else 0
        position = 3 if self.observe_position else 0
        game = 2 if self.observe_game else 0
        size = base + time + position + game + self.observe_arena
        return size + OWN_FRAME * self.observe_history

    @property
    def privileged_size(self) -> int:
        """Numbers of the privileged part of the observation, for the critic."""
        # evader, its velocity, own position, seen; own velocity and vehicle where these
        # are drawn
        return 3 + 3 + 3 + 1 + (3 + len(self.vehicles) if self.vehicles else 0)

"""The course of a flight: to the starts, game after game, back, and down."""

import math
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from openjax.flying.controller import follow_velocity
from openjax.flying.flight_record import FlightRecord
from openjax.flying.game import Game, Play
from openjax.flying.set_point import SetPoint, from_action
from openjax.flying.state import Mode, Request, State
from openjax.pursuit.environment import THRUST_LIMIT

TRANSFER = 20.0
"""All land if their starts aren't reached within this time (s)."""
SETTLE = 0.3
"""All wait for so long (s) at their starts before a game."""
UNDERWAY = {Mode.GROUND, Mode.TRANSFER, Mode.READY}
"""Modes of a vehicle on its way to its start."""


@dataclass(frozen=True)
class FlightPlan:
    """The plan of a flight."""

    episodes: int = 1
    """Games, one after the other; between them all fly back to their starts."""
    episode_seconds: float = math.inf
    """End each game after this time, if it isn't over before (s)."""


@dataclass
class Episode:
    """A game that is on."""

    number: int
    start: float  # s
    play: Play  # of its newest tick


class FlightCourse:
    """What a flight does next, and the games that it plays.

    Args:
      game: the policy and its game.
      plan: what to fly.
      record: where games are noted.

    Attributes:
      episode: the game that is on; None between games.
      since: when vehicles set out for their starts (s).
    """

    def __init__(self, game: Game, plan: FlightPlan, record: FlightRecord):
        self.episode: Episode | None = None
        self.since = perf_counter()
        self._game = game
        self._plan = plan
        self._record = record

    def request(self, state: State) -> tuple[Request, str]:
        """What the plan asks for at this tick, and why where something is wrong."""
        time = state.time
        modes = set(state.modes)
        # each vehicle must have said where it stands before any rises
        if modes == {Mode.GROUND} and all(d.estimate is not None for d in state.drones):
            return Request.TRANSFER, ""
        if modes == {Mode.READY} and self.episode is None:
            if time - max(d.since for d in state.drones) < SETTLE:
                return Request.NONE, ""
            is_last = len(self._record.games) >= self._plan.episodes
            return (Request.LAND if is_last else Request.PURSUE), ""
        if modes & UNDERWAY and time - self.since > TRANSFER:
            return Request.LAND, f"not all at their starts after {TRANSFER:g} s"
        if self.episode is not None and (
            self.episode.play.over or time - self.episode.start > self._plan.episode_seconds
        ):
            self.end_game("over")
            self.since = time
            return Request.TRANSFER, ""  # back to the starts, also to land there
        return Request.NONE, ""

    def actions(self, state: State, begins: bool) -> tuple[SetPoint, ...] | None:
        """The set-points that the policy, and the evader's rule, ask for; None where no game
        is on, nor `begins`. They know of poses only what was believed.
        """
        game = self._game
        poses = [drone.estimate for drone in state.drones]
        pursuers = poses[: game.settings.num_pursuers]
        evader = poses[-1] if len(poses) > len(pursuers) else None
        if begins:
            play = game.start(pursuers)
            self.episode = Episode(self._record.begin_game(play.draws), state.time, play)
        elif self.episode is None:
            return None
        else:
            play = game.step(pursuers, None if evader is None else np.array(evader.position))
            self.episode.play = play
            fastest = max(math.hypot(*pose.velocity) for pose in pursuers)
            # a measured velocity has noise: a per cent more is no fault
            self._record.count(play, fastest > 1.01 * game.settings.max_speed)
        set_points = [from_action(a, THRUST_LIMIT) for a in play.action]
        if evader is not None:
            # an evader that is a vehicle is steered to the velocity of its rule
            velocity = tuple(map(float, play.evader_velocity))
            trim = state.drones[-1].trim
            set_points.append(follow_velocity(evader, velocity, state.airframe, trim))
        return tuple(set_points)

    def end_game(self, reason: str) -> None:
        """The game that is on is over."""
        self._record.end_game(reason)
        self.episode = None

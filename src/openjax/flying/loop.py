"""The loop: a hundred times a second from poses to set-points, through take-off, games
and landing.

When a tick is due is `openjax.flying.ticks`', what is noted of it
`openjax.flying.flight_record`'s.
"""

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from openjax.flying.controller import accelerate, wanted_acceleration
from openjax.flying.estimation import see
from openjax.flying.flight_record import FlightRecord
from openjax.flying.game import Game
from openjax.flying.links import Links
from openjax.flying.safety import decide
from openjax.flying.set_point import RATES, from_action
from openjax.flying.state import Event, Mode, Request, SafetySettings, State, initial_state
from openjax.flying.ticks import TickSchedule, await_poses, measured_times
from openjax.pursuit.environment import THRUST_LIMIT

TRANSFER = 20.0
"""All land if their starts aren't reached within this time (s)."""
SETTLE = 0.3
"""All wait for so long (s) at their starts before a game."""


def flight_state(game: Game, number: int, safety: SafetySettings) -> State:
    """The state in which `number` vehicles stand before a game: pursuers, then, where
    it's a vehicle, the evader.
    """
    task = game.task
    settings = game.settings
    starts = [tuple(map(float, p)) for p in np.asarray(task.pursuer_position)]
    if number > settings.num_pursuers:
        starts.append(tuple(map(float, np.asarray(task.evader_position))))
    standing = np.asarray(task.pillar_position)[np.asarray(task.pillar_active)]
    pillars = [(float(x), float(y), settings.pillar_radius) for x, y in standing]
    return initial_state(starts, pillars, game.airframe, safety)


@dataclass(frozen=True)
class FlightPlan:
    """The plan of a flight."""

    episodes: int = 1
    """Games, one after the other; between them all fly back to their starts."""
    episode_seconds: float = math.inf
    """End each game after this time, if it isn't over before (s)."""


class FlightLoop:
    """One flight: take-off, games, landing.

    Args:
      vehicles: links to them; the pursuers first, then, where it's a vehicle, the
      evader.
      game: the policy and its game.
      state: before it, see `flight_state`.
      plan: what to fly.
      requests: asked at every tick for what the operator wants.
      watch: called after every tick with time and state; if it returns anything, all
      land for that reason.
      record: what is kept of it.
    """

    def __init__(
        self,
        vehicles: Links,
        game: Game,
        state: State,
        plan: FlightPlan,
        requests: Callable[[], Request] = lambda: Request.NONE,
        watch: Callable[[float, State], str] = lambda now, state: "",
        record: FlightRecord | None = None,
    ):
        self.vehicles = vehicles
        self.game = game
        self.state = state
        self.plan = plan
        self._requests = requests
        self._watch = watch
        self._pursuers = game.settings.num_pursuers
        self._evader_flies = len(state.drones) > self._pursuers
        self.record = record or FlightRecord(len(state.drones))
        self._play = None
        self._episode = -1
        self._begun = 0.0
        self._since = perf_counter()
        self._alarm = ""

    def run(self) -> FlightRecord:
        """Fly it. Returns when all motors are off."""
        gc.disable()  # a search for garbage would cost ticks
        try:
            schedule = TickSchedule(perf_counter())
            self._since = perf_counter()
            while not self.over:
                self.tick(perf_counter(), schedule.due)
                due = schedule.next(perf_counter(), measured_times(self.vehicles.observe()))
                await_poses(self.vehicles, due)
        finally:
            gc.enable()
        return self.record

    @property
    def over(self) -> bool:
        """True if all that flew is down, or nothing is going to fly."""
        # half a second for the first poses to come, before which all stand on the
        # ground
        if self.state.flying or self.state.time - self._since < 0.5:
            return False
        return self.state.all_in(Mode.LANDED, Mode.STOPPED) or any(
            d.reason for d in self.state.drones
        )

    def tick(self, time: float, due: float) -> None:
        """One tick at `time` that was due at `due` (s)."""
        arrivals = self.vehicles.arrivals()
        samples = self.vehicles.observe()
        old_drones = self.state.drones
        self.state = see(self.state, time, samples)
        for i, (drone, old) in enumerate(zip(self.state.drones, old_drones, strict=True)):
            # only what was believed goes to the estimators on board, and each pose once
            if drone.captured.pose is not old.captured.pose:
                self.vehicles.believed(i, drone.captured.pose, drone.feeds_estimator)
        # the operator before the watch, the watch before the plan
        request = self._requests() or (Request.LAND if self._alarm else self._plan(time))
        actions = None
        if self._episode >= 0 or request is Request.PURSUE:
            actions = self._actions(time, request is Request.PURSUE)
        self.state, set_points = decide(
            self.state, Event(time, samples, actions, request, self._alarm)
        )
        sent_at = self.vehicles.send(set_points)
        self._alarm = self._watch(time, self.state)
        # after the set-points have left: they mustn't wait for it
        self.record.keep(
            (due, sent_at, self._episode), arrivals, measured_times(samples), set_points
        )
        if self._episode >= 0 and not any(m is Mode.PURSUIT for m in self.state.modes):
            self._end_episode("safety")

    def _plan(self, time) -> Request:
        """The plan's set-points at this tick."""
        state = self.state
        plan = self.plan
        delay = time - self._since
        # each vehicle must have said where it stands before any rises
        if state.all_in(Mode.GROUND) and all(d.estimate is not None for d in state.drones):
            return Request.TRANSFER
        if state.all_in(Mode.READY) and self._episode < 0:
            if time - max(d.since for d in state.drones) < SETTLE:
                return Request.NONE
            if len(self.record.games) >= plan.episodes:
                return Request.LAND
            return Request.PURSUE
        underway = (Mode.GROUND, Mode.TRANSFER, Mode.READY)
        if any(mode in underway for mode in state.modes) and delay > TRANSFER:
            self._alarm = f"not all at their starts after {TRANSFER:g} s"
            return Request.LAND
        if self._episode >= 0 and (self._play.over or time - self._begun > plan.episode_seconds):
            self._end_episode("over")
            self._since = time
            return Request.TRANSFER  # back to the starts, also to land there
        return Request.NONE

    def _actions(self, time, first):
        """The set-points that the policy, and the evader's rule, ask for; they know of
        poses only what was believed.
        """
        poses = [drone.estimate for drone in self.state.drones]
        if first:
            self._play = self.game.start(poses[: self._pursuers])
            self._episode = self.record.begin_game(self._play.draws)
            self._begun = time
        else:
            evader = np.array(poses[-1].position) if self._evader_flies else None
            self._play = self.game.step(poses[: self._pursuers], evader)
            fastest = max(math.hypot(*pose.velocity) for pose in poses[: self._pursuers])
            # a measured velocity has noise: a per cent more is no fault
            self.record.count(self._play, fastest > 1.01 * self.game.settings.max_speed)
        set_points = [from_action(a, THRUST_LIMIT) for a in self._play.action]
        if self._evader_flies:
            set_points.append(self._steer_evader(poses[-1]))
        return tuple(set_points)

    def _steer_evader(self, pose):
        """The set-point of an evader that is a vehicle, at `pose`: to the velocity of
        its rule.
        """
        velocity = tuple(float(v) for v in self._play.evader_velocity)
        acceleration = wanted_acceleration(pose.velocity, velocity)
        trim = self.state.drones[-1].trim
        return accelerate(pose.quaternion, acceleration, self.state.airframe, trim, RATES)

    def _end_episode(self, reason):
        self.record.end_game(reason)
        self._episode = -1

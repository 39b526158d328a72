"""The loop: a hundred times a second from poses to set-points, on time, with a record of how well
that went.
"""

import gc
import itertools
import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from openjax.flying.controller import accelerate, wanted_acceleration
from openjax.flying.estimation import see
from openjax.flying.game import Game
from openjax.flying.links import Links
from openjax.flying.safety import decide
from openjax.flying.set_point import OFF, RATES, as_sent, from_action
from openjax.flying.state import Event, Mode, Request, SafetySettings, State, initial_state
from openjax.pursuit.environment import THRUST_LIMIT

PERIOD = 0.01
"""Of the ticks (s)."""
MARGIN = 2.0e-3
"""A tick is due this long after the newest poses were measured (s), as far as the fastest packets
tell.
"""
EARLY = 3.0e-3
"""A tick begins as soon as all poses are there, up to this much before it is due (s)."""
PATIENCE = 5.0e-3
"""It begins without them this long after it could have begun (s)."""
TRANSFER = 20.0
"""All land if their starts aren't reached within this time (s)."""
SETTLE = 0.3
"""All wait for so long (s) at their starts before a game."""
GONE = 0.1
"""A vehicle whose newest pose is older (s) isn't waited for."""


class Record:
    """What happened at every tick of a flight with `vehicles`; as numbers, since objects would take
    two kilobytes a tick.

    Attributes:
      episodes: notes on each game.
      skipped: ticks that were left out because the one before took too long.
    """

    def __init__(self, vehicles: int):
        self._rows = array("d")
        self._width = 3 + 7 * vehicles
        self.episodes: list[dict] = []
        self.skipped = 0

    def keep(self, tick, arrivals, measured, set_points) -> None:
        """Add a row.

        Args:
          tick: when it was due, when its last set-point left (s), and the game (-1: none).
          arrivals, measured: when each vehicle's newest pose arrived and was measured (s).
          set_points: each vehicle's.
        """
        self._rows.extend(tick)
        for arrival, seen, s in zip(arrivals, measured, set_points, strict=True):
            s = s if s.mode == OFF else as_sent(s)
            self._rows.extend((arrival, seen, s.mode, s.thrust, s.roll, s.pitch, s.yaw_rate))

    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """(T, 3) due, sent, game; (T, N, 7) arrival, measured, mode, thrust, roll, pitch, yaw rate
        as they fit into packets.
        """
        rows = np.array(self._rows).reshape(-1, self._width)
        # the number of vehicles is spelt out: a flight may end before its first tick
        return rows[:, :3], rows[:, 3:].reshape(len(rows), self._width // 7, 7)

    def timing(self) -> dict:
        """Command age (ms) and missed deadlines of all ticks. A tick's deadline is the next tick's
        due time; a tick that was left out is a missed one.

        `measured_to_sent_ms` counts from the moment on board, as far as the fastest packet of the
        flight tells it.
        """
        ticks, vehicles = self.table()
        if not len(ticks):
            return {"ticks": 0}
        due, sent, _ = ticks.T
        # of each tick the vehicle with the oldest pose counts
        age, measured = 1e3 * (sent[:, None, None] - vehicles[..., :2]).max(1).T
        work = 1e3 * (sent - due)
        gaps = 1e3 * np.diff(sent)
        missed = int((work > 1e3 * PERIOD).sum()) + self.skipped
        return {
            "ticks": len(due),
            "seconds": round(sent[-1] - due[0], 2),
            "command_age_ms": _percentiles(age),
            "measured_to_sent_ms": _percentiles(measured),
            "due_to_sent_ms": _percentiles(work),
            "between_set_points_ms": _percentiles(gaps) if len(gaps) else {},
            "missed_deadlines": missed,
            "missed_share": missed / (len(due) + self.skipped),
        }


def _percentiles(values) -> dict:
    at = np.percentile(values, [50, 99, 99.9, 100])
    return {n: round(float(v), 3) for n, v in zip(("p50", "p99", "p99.9", "max"), at, strict=True)}


class TickSchedule:
    """When the ticks are due: every 10 ms, just after the moments at which poses are measured.

    Those moments are regular, unlike arrivals: the vehicles send by clocks of their own, which
    drift a little.
    """

    def __init__(self, now: float):
        self.due = now
        self.skipped = 0
        self._in_step = False

    def next(self, time: float, measured: Sequence[float]) -> float:
        """The next tick's time, after one that ended at `time` and knew poses measured at
        `measured` (s).
        """
        ages = sorted((self.due - t) % PERIOD for t in measured if time - t < GONE)
        shift = 0.0
        if ages:
            # poses come in a bunch: the newest of a bunch is the one after the longest pause
            pauses = [ages[0] + PERIOD - ages[-1]]
            pauses += [older - newer for newer, older in itertools.pairwise(ages)]
            newest = ages[pauses.index(max(pauses))]
            # the way round the period that is shorter
            error = (newest - MARGIN + PERIOD / 2) % PERIOD - PERIOD / 2
            # slowly, once in step: one late packet mustn't move the ticks
            shift = min(max(0.02 * error, -1e-4), 1e-4) if self._in_step else error
            self._in_step = True
        self.due += PERIOD - shift
        while self.due < time - PERIOD:  # that one can't be caught up with any more
            self.due += PERIOD
            self.skipped += 1
        return self.due


def await_poses(vehicles: Links, due: float) -> None:
    """Return around `due` (s): as soon as each vehicle's newest pose is there that was measured
    before.
    """
    begun = perf_counter()
    latest = max(due, begun) + PATIENCE
    while True:
        now = perf_counter()
        stood_still = latest + PATIENCE < now < begun + GONE
        if now >= latest and not stood_still:
            return
        if stood_still:
            # so may the links have, which have first to pass on what came
            due = now - PATIENCE
            latest = now + PATIENCE
        measured = measured_times(vehicles.observe())
        complete = all(t > due - PERIOD or now - t > GONE for t in measured)
        if complete and now >= due - EARLY:
            return
        vehicles.wait(due - EARLY if complete else latest)


def measured_times(samples) -> tuple[float, ...]:
    """When each vehicle's newest pose was measured (s); minus infinity where there is none."""
    poses = (sample.captured or sample.own for sample in samples)
    return tuple(-math.inf if pose is None else pose.time for pose in poses)


def flight_state(game: Game, number: int, safety: SafetySettings) -> State:
    """The state in which `number` vehicles stand before a game: pursuers, then, where it's a
    vehicle, the evader.
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
class Plan:
    """What is to be flown."""

    episodes: int = 1
    """Games, one after the other; between them all fly back to their starts."""
    episode_seconds: float = math.inf
    """End each game after this time, if it isn't over before (s)."""


class Flight:
    """One flight: take-off, games, landing.

    Args:
      vehicles: links to them; the pursuers first, then, where it's a vehicle, the evader.
      game: the policy and its game.
      state: before it, see `flight_state`.
      plan: what to fly.
      requests: asked at every tick for what the operator wants.
      watched: called after every tick with time and state; if it returns anything, all land for
      that reason.
    """

    def __init__(
        self,
        vehicles: Links,
        game: Game,
        state: State,
        plan: Plan,
        requests: Callable[[], Request] = lambda: Request.NONE,
        watched: Callable[[float, State], str] = lambda now, state: "",
    ):
        self.vehicles = vehicles
        self.game = game
        self.state = state
        self.plan = plan
        self._requests = requests
        self._watched = watched
        self._pursuers = game.settings.num_pursuers
        self._evader_flies = len(state.drones) > self._pursuers
        self.record = Record(len(state.drones))
        self._play = None
        self._episode = -1
        self._begun = 0.0
        self._since = perf_counter()
        self._alarm = ""

    def run(self) -> Record:
        """Fly it. Returns when all motors are off."""
        gc.disable()  # a search for garbage would cost ticks
        try:
            schedule = TickSchedule(perf_counter())
            self._since = perf_counter()
            while not self.over:
                self.tick(perf_counter(), schedule.due)
                due = schedule.next(perf_counter(), measured_times(self.vehicles.observe()))
                self.record.skipped = schedule.skipped
                await_poses(self.vehicles, due)
        finally:
            gc.enable()
        return self.record

    @property
    def over(self) -> bool:
        """Whether all that flew is down, or nothing is going to fly."""
        # half a second for the first poses to come, before which all stand on the ground
        if self.state.flying or self.state.time - self._since < 0.5:
            return False
        return self.state.all_in(Mode.LANDED, Mode.STOPPED) or any(
            d.reason for d in self.state.drones
        )

    def tick(self, time: float, due: float) -> None:
        """One tick at `time` that was due at `due` (s)."""
        arrivals = self.vehicles.arrivals()
        samples = self.vehicles.observe()
        before = self.state.drones
        self.state = see(self.state, time, samples)
        for i, (drone, old) in enumerate(zip(self.state.drones, before, strict=True)):
            if drone.captured.pose is not old.captured.pose:
                self.vehicles.believed(i, drone.captured.pose, drone.feeds_estimator)
        # the operator before the watch, the watch before the plan
        request = self._requests() or (Request.LAND if self._alarm else self._planned(time))
        actions = None
        if self._episode >= 0 or request is Request.PURSUE:
            actions = self._actions(time, request is Request.PURSUE)
        self.state, set_points = decide(
            self.state, Event(time, samples, actions, request, self._alarm)
        )
        sent = self.vehicles.send(set_points)
        self._alarm = self._watched(time, self.state)
        self.record.keep((due, sent, self._episode), arrivals, measured_times(samples), set_points)
        if self._episode >= 0 and not any(m is Mode.PURSUIT for m in self.state.modes):
            self._end_episode("safety")

    def _planned(self, time) -> Request:
        """What the plan asks for at this tick."""
        state = self.state
        plan = self.plan
        waited = time - self._since
        if state.all_in(Mode.GROUND) and all(d.estimate is not None for d in state.drones):
            return Request.TRANSFER
        if state.all_in(Mode.READY) and self._episode < 0:
            if time - max(d.since for d in state.drones) < SETTLE:
                return Request.NONE
            if len(self.record.episodes) >= plan.episodes:
                return Request.LAND
            return Request.PURSUE
        underway = (Mode.GROUND, Mode.TRANSFER, Mode.READY)
        if any(mode in underway for mode in state.modes) and waited > TRANSFER:
            self._alarm = f"not all at their starts after {TRANSFER:g} s"
            return Request.LAND
        if self._episode >= 0 and (self._play.over or time - self._begun > plan.episode_seconds):
            self._end_episode("over")
            self._since = time
            return Request.TRANSFER  # back to the starts, also to land there
        return Request.NONE

    def _actions(self, time, first):
        """The set-points that the policy, and the evader's rule, ask for; they know of poses only
        what was believed.
        """
        poses = [drone.estimate for drone in self.state.drones]
        if first:
            self._play = self.game.start(poses[: self._pursuers])
            self._episode = len(self.record.episodes)
            self._begun = time
            notes = {"capture_step": None, "breaches": 0, "crash": False, "steps": 0, "end": ""}
            self.record.episodes.append(notes | {"over_speed": 0})
        else:
            evader = np.array(poses[-1].position) if self._evader_flies else None
            self._play = self.game.step(poses[: self._pursuers], evader)
            self._note(poses[: self._pursuers])
        set_points = [from_action(a, THRUST_LIMIT) for a in self._play.action]
        if self._evader_flies:
            set_points.append(self._steer_evader(poses[-1]))
        return tuple(set_points)

    def _note(self, pursuers):
        """What happened in the game's newest step, with the pursuers at these poses."""
        play = self._play
        notes = self.record.episodes[-1]
        notes["steps"] += 1
        if play.captured and notes["capture_step"] is None:
            notes["capture_step"] = notes["steps"]
        notes["breaches"] += int(play.breaches.any())
        notes["crash"] |= bool(play.crashed.any())
        fastest = max(math.hypot(*pose.velocity) for pose in pursuers)
        # a measured velocity has noise: a per cent more is no fault
        notes["over_speed"] += fastest > 1.01 * self.game.settings.max_speed

    def _steer_evader(self, pose):
        """The set-point of an evader that is a vehicle, at `pose`: to the velocity of its rule."""
        wanted = tuple(float(v) for v in self._play.evader_velocity)
        acceleration = wanted_acceleration(pose.velocity, wanted)
        trim = self.state.drones[-1].trim
        return accelerate(pose.quaternion, acceleration, self.state.airframe, trim, RATES)

    def _end_episode(self, why):
        self.record.episodes[-1]["end"] = why
        self._episode = -1

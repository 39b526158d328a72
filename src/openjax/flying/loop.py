"""The loop: a hundred times a second from poses to set-points, through take-off, games and landing.

When a tick is due is `openjax.flying.ticks`', what it asks for `openjax.flying.course`', what is
noted of it `openjax.flying.flight_record`'s.
"""

import gc
from collections.abc import Callable
from time import perf_counter

import numpy as np

from openjax.flying.course import FlightCourse, FlightPlan
from openjax.flying.estimation import see
from openjax.flying.flight_record import FlightRecord
from openjax.flying.game import Game
from openjax.flying.links import Links
from openjax.flying.safety import decide
from openjax.flying.state import Event, Mode, Request, SafetySettings, State, initial_state
from openjax.flying.ticks import TickSchedule, await_poses, measured_times


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
        self.state = state
        self.record = record or FlightRecord(len(state.drones))
        self.course = FlightCourse(game, plan, self.record)
        self._requests = requests
        self._watch = watch
        self._alarm = ""

    def run(self) -> FlightRecord:
        """Fly it. Returns when all motors are off."""
        gc.disable()  # a search for garbage would cost ticks
        try:
            schedule = TickSchedule(perf_counter())
            self.course.since = perf_counter()
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
        # half a second for the first poses to come, before which all stand on the ground
        if self.state.flying or self.state.time - self.course.since < 0.5:
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
        request = self._requests() or (Request.LAND if self._alarm else Request.NONE)
        if request is Request.NONE:
            request, self._alarm = self.course.request(self.state)
        actions = self.course.actions(self.state, begins=request is Request.PURSUE)
        self.state, set_points = decide(
            self.state, Event(time, samples, actions, request, self._alarm)
        )
        sent_at = self.vehicles.send(set_points)
        self._alarm = self._watch(time, self.state)
        # after the set-points have left: they mustn't wait for it
        episode = self.course.episode
        number = -1 if episode is None else episode.number
        self.record.keep((due, sent_at, number), arrivals, measured_times(samples), set_points)
        if episode is not None and not any(m is Mode.PURSUIT for m in self.state.modes):
            self.course.end_game("safety")

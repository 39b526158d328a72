"""The record of every tick of a flight, and of how punctual it was."""

from array import array
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from openjax.flying.set_point import OFF, as_sent
from openjax.flying.ticks import PERIOD

NOTED = 100
"""The notes on a game are handed on each time it is so many steps older."""


@dataclass
class GameNotes:
    """The outcome of one game."""

    capture_step: int | None = None
    breaches: int = 0
    """Steps in which a pursuer came too close to something."""
    crash: bool = False
    steps: int = 0
    end: str = ""
    over_speed: int = 0
    """Steps in which a pursuer was faster than the game allows."""
    draws: tuple[float, ...] = ()
    """The strategies that the team drew for it, see `openjax.flying.game.Play`."""

    def count(self, play, is_too_fast: bool) -> None:
        """Add a step, see `openjax.flying.game.Play`."""
        self.steps += 1
        if play.captured and self.capture_step is None:
            self.capture_step = self.steps
        self.breaches += int(play.breaches.any())
        self.crash |= bool(play.crashed.any())
        self.over_speed += is_too_fast


class FlightRecord:
    """A record of every tick of a flight with `vehicles`, kept as numbers, since objects would take
    two kilobytes a tick.

    Args:
      vehicles: their number.
      tell_tick: called with the bytes of each tick's row.
      tell_game: called with a game's number and its notes when it begins, when it ends,
      and each second in between.

    Attributes:
      games: notes on each game.
    """

    def __init__(
        self,
        vehicles: int,
        tell_tick: Callable[[bytes], None] = lambda row: None,
        tell_game: Callable[[int, dict], None] = lambda number, notes: None,
    ):
        self._rows = array("d")
        self._width = 3 + 7 * vehicles
        self._tell_tick = tell_tick
        self._tell_game = tell_game
        self.games: list[GameNotes] = []

    def keep(self, tick, arrivals, measured_times, set_points) -> None:
        """Add a row.

        Args:
          tick: when it was due, when its last set-point left (s), and the game (-1:
          none).
          arrivals, measured_times: when each vehicle's newest pose arrived and was measured
          (s).
          set_points: each vehicle's.
        """
        row = array("d", tick)
        for arrival, measured_at, s in zip(arrivals, measured_times, set_points, strict=True):
            # what a packet holds, not what was asked for: a diagnosis must know what was sent
            s = s if s.mode == OFF else as_sent(s)
            row.extend((arrival, measured_at, s.mode, s.thrust, s.roll, s.pitch, s.yaw_rate))
        self._rows.extend(row)
        self._tell_tick(row.tobytes())

    def add(self, rows: bytes) -> None:
        """Add rows that another record told."""
        self._rows.frombytes(rows)

    def begin_game(self, draws: tuple[float, ...] = ()) -> int:
        """The number of a game that begins now, in which a team flies what it drew."""
        self.games.append(GameNotes(draws=draws))
        return self._hand_on()

    def count(self, play, is_too_fast: bool) -> None:
        """Add a step to the newest game."""
        self.games[-1].count(play, is_too_fast)
        if self.games[-1].steps % NOTED == 0:
            self._hand_on()

    def end_game(self, reason: str) -> None:
        """The newest game is over."""
        self.games[-1].end = reason
        self._hand_on()

    def _hand_on(self) -> int:
        number = len(self.games) - 1
        self._tell_game(number, asdict(self.games[-1]))
        return number

    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """(T, 3) due, sent, game; (T, N, 7) arrival, measured, mode, thrust, roll,
        pitch, yaw rate as they fit into packets.
        """
        rows = np.array(self._rows).reshape(-1, self._width)
        # the number of vehicles is spelt out: a flight may end before its first tick
        return rows[:, :3], rows[:, 3:].reshape(len(rows), self._width // 7, 7)

    def timing(self) -> dict:
        """Command age (ms) and missed deadlines of all ticks. A tick's deadline is the
        next tick's due time; a tick that was left out is a missed one.

        `measured_to_sent_ms` counts from the moment on board, as far as the fastest
        packet of the flight tells it.
        """
        ticks, vehicles = self.table()
        if not len(ticks):
            return {"ticks": 0}
        due, sent_at, _ = ticks.T
        # of each tick the vehicle with the oldest pose counts
        age, latency = 1e3 * (sent_at[:, None, None] - vehicles[..., :2]).max(1).T
        work = 1e3 * (sent_at - due)
        gaps = 1e3 * np.diff(sent_at)
        # a schedule that stood still goes on with a tick that is due some periods later
        omissions = int(np.maximum(np.rint(np.diff(due) / PERIOD) - 1.0, 0.0).sum())
        misses = int((work > 1e3 * PERIOD).sum()) + omissions
        return {
            "ticks": len(due),
            "seconds": round(sent_at[-1] - due[0], 2),
            "command_age_ms": _percentiles(age),
            "measured_to_sent_ms": _percentiles(latency),
            "due_to_sent_ms": _percentiles(work),
            "between_set_points_ms": _percentiles(gaps) if len(gaps) else {},
            "missed_deadlines": misses,
            "missed_share": misses / (len(due) + omissions),
        }


def _percentiles(values) -> dict:
    at = np.percentile(values, [50, 99, 99.9, 100])
    return {n: round(float(v), 3) for n, v in zip(("p50", "p99", "p99.9", "max"), at, strict=True)}

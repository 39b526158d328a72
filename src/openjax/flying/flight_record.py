"""What happened at every tick of a flight, and how well it was on time."""

from array import array

import numpy as np

from openjax.flying.set_point import OFF, as_sent
from openjax.flying.ticks import PERIOD


class FlightRecord:
    """What happened at every tick of a flight with `vehicles`; as numbers, since
    objects would take two kilobytes a tick.

    Attributes:
      episodes: notes on each game.
      skipped: ticks that were left out because the one before took too long.
    """

    def __init__(self, vehicles: int):
        self._rows = array("d")
        self._width = 3 + 7 * vehicles
        self.episodes: list[dict] = []
        self.skipped = 0

    def keep(self, tick, arrivals, measured_times, set_points) -> None:
        """Add a row.

        Args:
          tick: when it was due, when its last set-point left (s), and the game (-1:
          none).
          arrivals, measured_times: when each vehicle's newest pose arrived and was measured
          (s).
          set_points: each vehicle's.
        """
        self._rows.extend(tick)
        for arrival, measured_at, s in zip(arrivals, measured_times, set_points, strict=True):
            # what a packet holds, not what was asked for: a diagnosis must know what
            # was sent
            s = s if s.mode == OFF else as_sent(s)
            self._rows.extend((arrival, measured_at, s.mode, s.thrust, s.roll, s.pitch, s.yaw_rate))

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
        misses = int((work > 1e3 * PERIOD).sum()) + self.skipped
        return {
            "ticks": len(due),
            "seconds": round(sent_at[-1] - due[0], 2),
            "command_age_ms": _percentiles(age),
            "measured_to_sent_ms": _percentiles(latency),
            "due_to_sent_ms": _percentiles(work),
            "between_set_points_ms": _percentiles(gaps) if len(gaps) else {},
            "missed_deadlines": misses,
            "missed_share": misses / (len(due) + self.skipped),
        }


def _percentiles(values) -> dict:
    at = np.percentile(values, [50, 99, 99.9, 100])
    return {n: round(float(v), 3) for n, v in zip(("p50", "p99", "p99.9", "max"), at, strict=True)}

"""Rotors along rows of motor commands: delay and lag solved exactly within every row.

The rotor model is the simulator's (`openjax.vehicle.rotors`): T dw/dt = w_commanded -
w, thrust in proportion to w^2, T different for speeding up and slowing down. A row's
command holds until the next row.

Rotors forget where they came from within some time constants. So flights are cut into
lanes, each begun a while earlier, that run side by side: the loop is over the rows of
one lane, and nothing has to be compiled for a flight's length.
"""

from collections.abc import Sequence

import numpy as np

SMALLEST = 1e-8  # of a command: dead motors have a speed, too
LANE = 150  # rows
FORGOTTEN = 16.0  # time constants, after which 1e-7 is left


def rotor_rows(
    commands: Sequence[np.ndarray], dt: float, lags: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Mean thrust of each row (B, T, 4) and speed at its end (B, T, 4), as shares of
    the largest, for each of some flights' commands (T, 4) in rows of dt s, with B
    `lags` (B, 3): time constants of speeding up and of slowing down, and delay, s.
    """
    lanes = _Lanes([len(c) for c in commands], int(np.ceil(FORGOTTEN * lags[:, :2].max() / dt)))
    targets_of_flights = [np.sqrt(np.clip(c, SMALLEST, None)) for c in commands]
    whole = np.floor(lags[:, 2] / dt).astype(int)
    late = lags[:, 2] - whole * dt
    # A row begins with the command before, as long as it is late.
    up, down = lags[:, :2].T
    parts = [_Part(up, down, late), _Part(up, down, dt - late)]
    targets = [[_delay(w, whole + more) for w in targets_of_flights] for more in (1, 0)]
    begins = lanes.run(parts, targets)

    out = []
    for begin, first, second in zip(begins, *targets, strict=True):
        middle = parts[0].end_speed(begin, first)
        square = parts[0].square(begin, first) + parts[1].square(middle, second)
        out.append((square / dt, parts[1].end_speed(middle, second)))
    return out


def _delay(targets: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Wanted speeds (T, 4) so many `rows` (B,) later: (B, T, 4)."""
    count = len(targets)
    return targets[np.clip(np.arange(count) - rows[:, None], 0, count - 1)]


class _Part:
    """A part of a row, `span` (B,) s long, in which commands hold; `up` and `down` (B,)
    s.
    """

    def __init__(self, up: np.ndarray, down: np.ndarray, span: np.ndarray):
        self.up, self.down, self.span = (v[:, None, None] for v in (up, down, span))
        self.decay_up = np.exp(-self.span / self.up)
        self.decay_down = np.exp(-self.span / self.down)

    def end_speed(self, speed: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Speed at the part's end (B, ..., 4)."""
        off = speed - target
        return target + off * np.where(off > 0.0, self.decay_down, self.decay_up)

    def square(self, speed: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Integral of the square of the speed over the part, s (B, ..., 4)."""
        off = speed - target
        falls = off > 0.0
        decay = np.where(falls, self.decay_down, self.decay_up)
        moving = 2.0 * target * (1.0 - decay) + 0.5 * off * (1.0 - decay * decay)
        return target * target * self.span + off * np.where(falls, self.down, self.up) * moving


class _Lanes:
    """Flights of `counts` rows cut into lanes that begin `lead` rows before what they
    are for.
    """

    def __init__(self, counts: list[int], lead: int):
        self.counts = counts
        self.lead = lead
        firsts = np.cumsum([0, *counts[:-1]])
        rows = []
        for first, count in zip(firsts, counts, strict=True):
            begins = np.arange(0, count, LANE)[:, None] - lead
            # Before a flight its first command held; what a lane has beyond the end is
            # left out.
            rows.append(first + np.clip(begins + np.arange(lead + LANE), 0, count - 1))
        self.rows = np.concatenate(rows).T  # (lead + LANE, lanes)

    def run(self, parts: list[_Part], targets: list[list[np.ndarray]]) -> list[np.ndarray]:
        """Speeds (B, T, 4) at the rows' begin of each flight, for its targets
        (B, T, 4) in the two parts of a row.
        """
        target_lanes = [np.moveaxis(np.concatenate(t, 1)[:, self.rows], 1, 0) for t in targets]
        speed = target_lanes[0][0]  # (B, lanes, 4)
        begin = np.empty_like(target_lanes[0])
        for row, (first, second) in enumerate(zip(*target_lanes, strict=True)):
            begin[row] = speed
            speed = parts[1].end_speed(parts[0].end_speed(speed, first), second)

        speeds = np.moveaxis(begin[self.lead :], 0, 2)  # (B, lanes, LANE, 4)
        out = []
        lane = 0
        for count in self.counts:
            lanes = -(-count // LANE)
            flight = speeds[:, lane : lane + lanes].reshape(len(speeds), -1, 4)
            out.append(flight[:, :count])
            lane += lanes
        return out

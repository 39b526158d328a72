"""A vehicle's clock, read by when its packets come."""

import math

DRIFT = 5e-5
"""Largest relative drift of two clocks (s/s): quartzes are good to some tens of ppm."""
_WRAP = 1 << 24
"""Milliseconds after which a time stamp of three bytes begins again."""


class OnboardClock:
    """On-board milliseconds (24 bit) to host seconds: the packet that came through
    fastest sets the difference.
    """

    def __init__(self):
        self.offset = math.inf
        self._last = 0.0
        self._stamp = None
        self._base = 0

    def host(self, stamp: int, arrival: float) -> float:
        """Host seconds of a time stamp that came at `arrival` (s)."""
        # only a step back by half of the range is a new turn: packets may overtake each other
        if self._stamp is not None and stamp < self._stamp - _WRAP // 2:
            self._base += _WRAP
        self._stamp = stamp
        on_board = 1e-3 * (stamp + self._base)
        # the smallest difference so far, let up by as much as clocks may have parted since
        if math.isfinite(self.offset):
            self.offset += DRIFT * (arrival - self._last)
        self.offset = min(self.offset, arrival - on_board)
        self._last = arrival
        return on_board + self.offset

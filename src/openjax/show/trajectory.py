"""One flown episode as host arrays, for pictures and animations."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """An episode of T steps with N pursuers. Lengths in metres, world frame."""

    title: str
    pursuer_position: np.ndarray  # (T, N, 3)
    pursuer_quaternion: np.ndarray  # (T, N, 4) wxyz, body to world
    evader_position: np.ndarray  # (T, 3)
    captured: np.ndarray  # (T, N) bool, pursuers that capture in this step
    crashed: np.ndarray
    """(T, N) bool, pursuers that touch something solid or lie on their side in this
    step
    """
    pillar_position: np.ndarray  # (P, 2), those in use
    arena_radius: float
    arena_height: float
    pillar_radius: float
    capture_radius: float
    time_step: float  # s
    seen: np.ndarray | None = None  # (T,) bool, whether some pursuer sees the evader
    predicted: np.ndarray | None = None
    """(T, K, 3) where the policy expects the evader in the steps after"""

    @property
    def capture_index(self) -> int | None:
        """Index of the first step with a capture."""
        return _first(self.captured.any(axis=-1))

    @property
    def crash_index(self) -> int | None:
        """Index of the first step with a crash."""
        return _first(self.crashed.any(axis=-1))

    def crash_of(self, pursuer: int) -> int | None:
        """Index of the first step in which this pursuer crashes."""
        return _first(self.crashed[:, pursuer])

    def end(self, seconds: float = 1.0) -> int:
        """Number of steps worth showing: up to so many seconds after the first capture,
        or all.
        """
        steps = len(self.evader_position)
        if self.capture_index is None:
            return steps
        return min(steps, self.capture_index + round(seconds / self.time_step))


def _first(flags):
    steps = np.flatnonzero(flags)
    return int(steps[0]) if steps.size else None

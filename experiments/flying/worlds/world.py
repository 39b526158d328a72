"""What a world is: it flies bodies by commands, and says where they are and where they are seen."""

from typing import Protocol

import numpy as np

Poses = dict[str, np.ndarray]
"""position (W, N, 3) m, quaternion (W, N, 4) wxyz, velocity (W, N, 3) m/s of N pursuers in W worlds, float32."""


class World(Protocol):
    """W worlds with N vehicles each, at the start of their episodes. A tick is a control step, 10 ms."""

    def poses(self) -> Poses:
        """Where the vehicles are."""

    def measure(self) -> Poses:
        """Where the vehicles are seen at this tick: late, noisy, as the world has it."""

    def fly(self, command: np.ndarray) -> None:
        """One tick after sending `command` (W, N, 4): collective thrust in 0..1, body rates in rad/s."""


def per_world(team: int, position, quaternion, velocity) -> Poses:
    """Poses of bodies in the last axis, (3, W * N) and so on, as `Poses`."""
    parts = {"position": position, "quaternion": quaternion, "velocity": velocity}
    return {
        name: np.asarray(value).T.reshape(-1, team, len(value)).astype(np.float32)
        for name, value in parts.items()
    }

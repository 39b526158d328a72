"""A plan of set-points in a game's place: what `openjax fly --plan` flies with one vehicle.

It answers as `openjax.flying.game.Game` does, so the loop, its safety and its logs are the same.
"""

import math
from types import SimpleNamespace

import numpy as np

from openjax.flights.manoeuvres import PERIOD
from openjax.flights.plans import SetPoints
from openjax.flying.controller import (
    POSITION_GAIN,
    Airframe,
    Pose,
    accelerate,
    roll_pitch_yaw,
    wanted_acceleration,
)
from openjax.flying.game import Play
from openjax.flying.set_point import RATES

YAW_GAIN = 3.0
"""Yaw rate asked for per yaw error (1/s): twice the controller's, which only keeps the
nose where it is.
"""
LIFT_GAIN = 0.05
"""Share of the hovering thrust by which a height error of 1 m for 1 s changes the trim."""
MOST_TRIM = 0.1
"""Largest trim, as a share of full thrust."""
FASTEST = 10.0
"""m/s; no plan is a game in which speed counts as a fault."""


class PlannedFlight:
    """One vehicle along a plan, from its first row's place, once."""

    def __init__(self, plan: SetPoints, airframe: Airframe):
        self.airframe = airframe
        self.settings = SimpleNamespace(num_pursuers=1, pillar_radius=0.0, max_speed=FASTEST)
        self.task = SimpleNamespace(
            pursuer_position=plan.position[:1],
            evader_position=np.zeros(3),
            pillar_position=np.zeros((0, 2)),
            pillar_active=np.zeros(0, bool),
        )
        self._plan = plan
        self._row = 0
        self._trim = 0.0

    def start(self, poses: list[Pose]) -> Play:
        """Begin the plan with the vehicle at `poses`[0]."""
        self._row = 0
        self._trim = 0.0
        return self._play(poses[0])

    def step(self, poses: list[Pose], evader: np.ndarray | None = None) -> Play:
        """One row later the vehicle is at `poses`[0]; there is no evader."""
        self._row = min(self._row + 1, len(self._plan) - 1)
        return self._play(poses[0])

    def _play(self, pose: Pose) -> Play:
        return Play(
            action=self._action(pose)[None],
            evader_position=np.zeros(3),
            evader_velocity=np.zeros(3),
            captured=False,
            over=self._row >= len(self._plan) - 1,
            breaches=np.zeros(1),
            crashed=np.zeros(1, bool),
        )

    def _action(self, pose: Pose) -> np.ndarray:
        """(4,) thrust and body rates of a controller that follows the row, and what the
        plan adds, in -1..1 as a policy's.
        """
        plan = self._plan
        row = self._row
        error = plan.position[row] - pose.position
        self._trim += LIFT_GAIN * PERIOD * float(error[2])
        self._trim = min(max(self._trim, -MOST_TRIM), MOST_TRIM)
        velocity = plan.velocity[row] + POSITION_GAIN * error
        pull = (
            np.array(wanted_acceleration(pose.velocity, tuple(velocity))) + plan.acceleration[row]
        )
        set_point = accelerate(pose.quaternion, tuple(pull), self.airframe, self._trim, RATES)
        yaw = roll_pitch_yaw(pose.quaternion)[2]
        turn = math.remainder(plan.yaw[row] - yaw, 2.0 * math.pi)
        # what the plan itself turns until the next row is asked for beside the error's share
        ahead = plan.yaw[min(row + 1, len(plan) - 1)] - plan.yaw[row]
        rates = np.array([set_point.roll, set_point.pitch, YAW_GAIN * turn + ahead / PERIOD])
        thrust = set_point.thrust + plan.extra[row, 0]
        rates = rates + plan.extra[row, 1:]
        return np.clip(np.concatenate([[2.0 * thrust - 1.0], rates / math.pi]), -1.0, 1.0)

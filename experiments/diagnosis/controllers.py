"""Three off-board controllers that turn a reference and a measured pose into collective thrust and
body rates.

`geometric` aligns the thrust with the wanted acceleration; `cascade` is a chain of PIDs on
position, velocity and Euler angles, as firmware position controllers are; `preview` (stranger's
column only) tracks a point ahead, every 20 ms, with smoothed commands. All see the told mass and
thrust constant.
"""

import numpy as np

from experiments.diagnosis.vehicle import GRAVITY, cross, rotate_back

KINDS = ("geometric", "cascade")
STRANGERS = ("preview",)
PERIOD = {"geometric": 1, "cascade": 1, "preview": 2}  # in ticks of 10 ms
AHEAD = 8  # ticks that `preview` looks ahead


class Controllers:
    """The controllers of a batch: `kind` names one per body, `mass` (B,) kg and `most` (B,) N of
    all four rotors.
    """

    def __init__(self, kinds, mass, most, reference):
        self.kinds = np.array(kinds)
        self.mass = mass
        self.most = most
        self.reference = reference
        self.period = np.array([PERIOD[k] for k in kinds])
        count = len(kinds)
        self.integral, self.smooth = np.zeros((3, count)), np.zeros((3, count))
        self.command = None

    def __call__(self, k, position, q, velocity):
        """Commands (4, B) at tick k: thrust 0..1 and body rates rad/s; held where the controller is
        not due.
        """
        r = self.reference
        last = len(self.reference["position"]) - 1
        out = np.zeros((4, len(self.mass)))
        for kind in np.unique(self.kinds):
            own = self.kinds == kind
            at = min(k + AHEAD, last) if kind == "preview" else k
            goal = {name: r[name][at][..., own] for name in r if name != "pulses"}
            out[:, own] = getattr(self, "_" + kind)(
                own, goal, position[:, own], q[:, own], velocity[:, own]
            )
        out = out + r["pulses"][k]
        out[0] = np.clip(out[0], 0.08, 0.92)
        out[1:] = np.clip(out[1:], -np.pi, np.pi)
        self.command = (
            out if self.command is None else np.where(k % self.period == 0, out, self.command)
        )
        return self.command

    def _collect(self, own, error):
        """Position error integrated with a limit."""
        held = np.clip(self.integral[:, own] + 0.01 * np.clip(error, -0.2, 0.2), -0.5, 0.5)
        self.integral[:, own] = held
        return held

    def _thrust(self, own, want, up):
        return self.mass[own] * (want * up).sum(axis=0) / self.most[own]

    def _geometric(self, own, goal, position, q, velocity, gains=(6.0, 3.8, 8.0)):
        stiff, damp, turn = gains
        error = goal["position"] - position
        want = goal["acceleration"] + np.array([[stiff], [stiff], [2 * stiff]]) * error
        want = want + np.array([[damp], [damp], [1.45 * damp]]) * (goal["velocity"] - velocity)
        want = want + np.array([[1.5], [1.5], [5.0]]) * self._collect(own, error)
        want[2] = np.clip(want[2], -6.0, 8.0) + GRAVITY
        side = np.sqrt(want[0] ** 2 + want[1] ** 2)
        want[:2] *= np.minimum(
            1.0, 0.78 * want[2] / np.maximum(side, 1e-9)
        )  # at most 38 degrees of tilt
        w, x, y, z = q
        up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        lean = rotate_back(q, cross(up, want / np.sqrt((want * want).sum(axis=0))))
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        twist = (goal["yaw"] - heading + np.pi) % (2 * np.pi) - np.pi
        return np.stack(
            [
                self._thrust(own, want, up),
                turn * lean[0],
                turn * lean[1],
                3.0 * twist + goal["yaw_rate"],
            ]
        )

    def _cascade(self, own, goal, position, q, velocity):
        error = goal["position"] - position
        wanted = goal["velocity"] + 2.0 * error
        slip = wanted - velocity
        want = np.array([[4.5], [4.5], [6.5]]) * slip
        want = want + np.array([[1.2], [1.2], [5.0]]) * self._collect(own, error)
        want = want + 0.6 * goal["acceleration"]
        w, x, y, z = q
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        ahead = want[0] * np.cos(yaw) + want[1] * np.sin(yaw)
        aside = -want[0] * np.sin(yaw) + want[1] * np.cos(yaw)
        pitch_goal, roll_goal = (np.clip(v / GRAVITY, -0.5, 0.5) for v in (ahead, -aside))
        twist = (goal["yaw"] - yaw + np.pi) % (2 * np.pi) - np.pi
        thrust = self.mass[own] * (GRAVITY + np.clip(want[2], -5, 6)) / self.most[own]
        return np.stack([thrust, 6.5 * (roll_goal - roll), 6.5 * (pitch_goal - pitch), 3.5 * twist])

    def _preview(self, own, goal, position, q, velocity):
        ahead = position + 0.01 * AHEAD * velocity
        out = self._geometric(own, goal, ahead, q, velocity, gains=(4.0, 3.2, 6.0))
        self.smooth[:, own] += 0.5 * (out[1:] - self.smooth[:, own])
        return np.concatenate([out[:1], self.smooth[:, own]])

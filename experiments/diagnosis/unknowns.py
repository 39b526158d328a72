"""Causes outside the vocabulary: things that really act on a quadrotor and that no effect of the list describes.

`KINDS` may be drawn for development; `STRANGERS` are drawn for reported runs only, so that recall is that of kinds
which no tuning ever met. Each has a strength per body (0: absent) and eight uniform draws, once per case.
"""

from typing import NamedTuple

import numpy as np

from experiments.diagnosis.vehicle import GRAVITY, SPIN, rotate_back


class Kind(NamedTuple):
    """An unknown cause: (smallest, largest) strength and unit, missions that expose it, names that describe a part of it."""

    sizes: tuple
    unit: str
    missions: tuple
    parts: tuple


# name -> weakest, strongest, unit, missions, parts
_KINDS = {
    "slung_load": (1.0, 7.0, "g", ("agile", "step"), ("mass", "thrust_scale")),
    "loose_propeller": (0.03, 0.4, "mN m", (), ()),
    "lateral_jet": (2.0, 25.0, "mN", (), ("wind",)),
    "yaw_disturbance": (0.03, 0.3, "mN m", ("yaw",), ()),
    "late_motor_fault": (0.02, 0.15, "1", (), ("motor_imbalance",)),
    "thrust_oscillation": (0.01, 0.10, "1", (), ()),
    "elastic_tether": (10.0, 120.0, "mN/m", ("fast", "agile"), ()),
    "descent_loss": (0.02, 0.3, "1 per m/s", ("climb", "spiral"), ()),
    "roll_yaw_coupling": (0.02, 0.3, "mN m per (rad/s)", ("agile", "step"), ()),
    "sideways_kicks": (15.0, 120.0, "mN", (), ()),
    "gyro_scale": (0.04, 0.15, "1", ("agile", "yaw"), ()),
    "world_tilt": (1.5, 5.0, "deg", ("fast", "laps"), ("wind",)),
}
_STRANGERS = {
    "motor_hiccups": (0.15, 0.9, "1", (), ("packet_loss",)),
    "frame_resonance": (0.03, 0.6, "1", ("agile", "step"), ()),
    "magnet_point": (5.0, 50.0, "mN", ("agile", "low"), ()),
    "side_plume": (5.0, 40.0, "mN", ("fast", "agile"), ("wind",)),
    "coarse_steps": (0.02, 0.09, "1", ("agile", "climb"), ()),
    "cable_weight": (0.5, 6.0, "g per m", ("climb", "spiral"), ("mass", "thrust_scale")),
    "draught": (5.0, 60.0, "mN", (), ("wind",)),
    "marker_jumps": (0.01, 0.05, "m", ("agile", "step"), ()),
    "flexing_arm": (0.02, 0.25, "1 per N", ("agile", "climb"), ("thrust_curve", "motor_imbalance")),
    "moving_passenger": (0.03, 1.5, "mm", (), ("com_offset",)),
}
KINDS, STRANGERS = (
    {name: Kind((low, high), *rest) for name, (low, high, *rest) in kinds.items()}
    for kinds in (_KINDS, _STRANGERS)
)
ALL = KINDS | STRANGERS
SENSOR_KINDS = ("gyro_scale", "world_tilt", "marker_jumps")  # act on the logs, see `sensors`


class Unknowns:
    """Strengths and states of the unknown causes of one batch: {name: {"strength": (B,), "shape": (8, B)}}."""

    def __init__(self, causes, count):
        self.causes = {
            n: c for n, c in causes.items() if np.any(c["strength"] != 0) and n not in SENSOR_KINDS
        }
        self.count, self.state = count, {}

    def __bool__(self):
        return bool(self.causes)

    def _get(self, name):
        return self.causes[name]["strength"], self.causes[name]["shape"]

    def motors(self, u, time):
        """Effective thrust fraction (4, B) after causes that sit in the motors."""
        own = np.arange(self.count)
        if "late_motor_fault" in self.causes:
            s, shape = self._get("late_motor_fault")
            factor = np.ones_like(u)
            since = np.clip((time - (2.5 + 3.0 * shape[1])) / 0.2, 0.0, 1.0)
            factor[np.floor(4 * shape[0]).astype(int), own] = 1.0 - s * since
            u = u * factor
        if "thrust_oscillation" in self.causes:
            s, shape = self._get("thrust_oscillation")
            u = u * (1.0 + s * np.sin(2 * np.pi * (3.0 + 6.0 * shape[0]) * time + 6 * shape[1]))
        if "motor_hiccups" in self.causes:
            s, shape = self._get("motor_hiccups")
            phase = (time + 7 * shape[0]) / (0.35 + 0.5 * shape[1])
            slot = np.floor(phase)
            chance = (slot * 0.618034 + shape[2]) % 1.0
            off = (phase - slot < 0.12) & (chance < 0.6)
            factor = np.ones_like(u)
            factor[np.floor(4 * ((slot * 0.754877 + shape[3]) % 1.0)).astype(int), own] = 1.0 - s * off
            u = u * factor
        if "coarse_steps" in self.causes:
            s, _ = self._get("coarse_steps")
            step = np.maximum(s, 1e-6)
            u = np.where(s > 0, step * np.rint(u / step), u)
        if "flexing_arm" in self.causes:
            s, shape = self._get("flexing_arm")
            # the disk of one diagonal twists under load and loses thrust against the other
            twist = s * (1 + shape[0]) * (u - u.mean(axis=0))
            u = u * (1.0 + twist * (SPIN[:, None] > 0))
        return np.clip(u, 0.0, None)

    def wrench(self, time, position, q, velocity, rates, thrust, moment, mass):
        """Force (3, B) N and torque (3, B) N m in the body frame, beside the rotors' `moment` (3, B)."""
        force, torque = np.zeros((3, self.count)), np.zeros((3, self.count))
        zero = np.zeros(self.count)
        for name in self.causes:
            s, shape = self._get(name)
            if name == "slung_load":
                force = force + rotate_back(
                    q, self._slung(s * 1e-3, 0.1 + 0.1 * shape[0], position, velocity, mass)
                )
            elif name == "loose_propeller":
                wave = s * 1e-3 * np.sin(2 * np.pi * (6.0 + 14.0 * shape[0]) * time + 6 * shape[1])
                angle = 2 * np.pi * shape[2]
                torque = torque + wave * np.stack([np.cos(angle), np.sin(angle), zero])
            elif name == "lateral_jet":
                on = np.sin(2 * np.pi * time / (1.5 + 3.0 * shape[0]) + 6 * shape[1]) > 0
                angle = 2 * np.pi * shape[2]
                force = force + s * 1e-3 * on * np.stack([np.cos(angle), np.sin(angle), zero])
            elif name == "yaw_disturbance":
                heading = np.arctan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] ** 2 + q[3] ** 2))
                wave = np.sin(2 * np.pi * (0.5 + 1.5 * shape[0]) * time + heading)
                torque = torque + np.stack([zero, zero, s * 1e-3 * wave])
            elif name == "elastic_tether":
                anchor = np.stack([0.5 * shape[0] - 0.25, 0.5 * shape[1] - 0.25, zero])
                away = position - anchor
                length = np.sqrt((away * away).sum(axis=0)) + 1e-6
                pull = s * 1e-3 * np.maximum(length - 0.3 - 0.3 * shape[2], 0.0)
                force = force - rotate_back(q, pull * away / length)
            elif name == "descent_loss":
                lost = s * np.clip(-velocity[2] - 0.1, 0.0, 1.5) * thrust.sum(axis=0)
                force = force - np.stack([zero, zero, lost])
            elif name == "roll_yaw_coupling":
                torque = torque + np.stack([zero, zero, s * 1e-3 * rates[0]])
            elif name == "sideways_kicks":
                phase = (time + 10 * shape[0]) / (0.6 + 0.5 * shape[1])
                slot = np.floor(phase)
                angle = 2 * np.pi * ((slot * 0.754877 + shape[2]) % 1.0)
                kick = s * 1e-3 * (phase - slot < 0.08)
                force = force + rotate_back(q, kick * np.stack([np.cos(angle), np.sin(angle), zero]))
            elif name == "frame_resonance":
                # the frame rings at 7 to 16 Hz when the rotors' moment pushes it
                bend, speed = self.state.get(name, (np.zeros((2, self.count)), np.zeros((2, self.count))))
                w = 2 * np.pi * (7.0 + 9.0 * shape[0])
                speed = speed + 0.001 * (w * w * (moment[:2] - bend) - 0.3 * w * speed)
                bend = bend + 0.001 * speed
                self.state[name] = (bend, speed)
                torque = torque + np.concatenate([s * (bend - moment[:2]), zero[None]])
            elif name == "magnet_point":
                point = np.stack([0.6 * shape[0] - 0.3, 0.6 * shape[1] - 0.3, 0.2 + 0.6 * shape[2]])
                away = position - point
                near = np.exp(-0.5 * (away * away).sum(axis=0) / 0.15**2)
                force = force - rotate_back(q, s * 1e-3 * near * away / 0.15)
            elif name == "side_plume":
                angle, across = 2 * np.pi * shape[0], 2 * np.pi * shape[1]
                where = position[0] * np.cos(across) + position[1] * np.sin(across) - 0.4 * (shape[2] - 0.5)
                push = s * 1e-3 * np.exp(-0.5 * (where / 0.12) ** 2)
                force = force + rotate_back(q, push * np.stack([np.cos(angle), np.sin(angle), zero]))
            elif name == "cable_weight":
                force = force - rotate_back(
                    q, np.stack([zero, zero, s * 1e-3 * GRAVITY * np.maximum(position[2], 0)])
                )
            elif name == "draught":
                angle, start = 2 * np.pi * shape[0], 2.0 + 4.0 * shape[1]
                on = (time > start) & (time < start + 0.8 + shape[2])
                force = force + rotate_back(q, s * 1e-3 * on * np.stack([np.cos(angle), np.sin(angle), zero]))
            elif name == "moving_passenger":
                walk = np.stack(
                    [np.sin(2.4 * (0.5 + shape[0]) * time), np.cos(1.7 * (0.5 + shape[1]) * time), zero]
                )
                c = 1e-3 * s * np.sign(walk)
                total = thrust.sum(axis=0)
                torque = torque + np.stack([-c[1] * total, c[0] * total, zero])
        return force, torque

    def _slung(self, load, length, position, velocity, mass):
        """World force (3, B) of a load on a stiff, damped thread (spring 20 N/m) that cannot push."""
        below = np.stack([0.03 + 0 * length, 0 * length, length])
        where, speed = self.state.get("slung_load", (position - below, velocity))
        safe = np.maximum(load, 1e-5)
        apart = position - where
        distance = np.sqrt((apart * apart).sum(axis=0)) + 1e-9
        along = apart / distance
        closing = ((velocity - speed) * along).sum(axis=0)
        tension = (
            np.maximum(20.0 * (distance - length) + 0.15 * closing, 0.0) * (distance > length) * (load > 0)
        )
        tension = np.minimum(tension, (10 * safe + 0.2 * mass) * GRAVITY)
        acceleration = tension * along / safe
        acceleration[2] -= GRAVITY
        speed = speed + 0.001 * (acceleration - 0.3 * speed)
        self.state["slung_load"] = (where + 0.001 * speed, speed)
        return -tension * along

"""Causes outside the vocabulary: things that really act on a quadrotor and that no effect of the list
describes.

Each has a strength per body (0: absent) and a shape drawn once per case. `Strangers` holds the state that
some of them need.
"""

import numpy as np

from experiments.withheld.body import GRAVITY, MASS, SPIN, rotate_back

# name -> (strength of a typical case, unit, what it is)
KINDS = {
    "slung_load": (4.0, "g", "a load swinging on a thread below the vehicle"),
    "loose_propeller": (0.25, "mN m", "a torque oscillating about a lateral axis, as of a loose propeller"),
    "lateral_jet": (12.0, "mN", "a body-fixed lateral force that turns on and off"),
    "yaw_disturbance": (0.35, "mN m", "a periodic yaw torque fixed to the heading, as of a magnetic field"),
    "late_motor_fault": (0.12, "1", "one rotor loses part of its thrust in the middle of the flight"),
    "wall_suction": (18.0, "mN", "a pull towards the arena's wall close to it"),
    "rotor_precession": (
        1.0e-6,
        "kg m^2",
        "gyroscopic torque of heavy rotors and the reaction to spinning them up",
    ),
    "thrust_oscillation": (0.06, "1", "a thrust that oscillates at some hertz"),
    "elastic_tether": (60.0, "mN/m", "an elastic cord to a fixed point"),
    "translational_lift": (0.09, "1 per (m/s)^2", "thrust that grows with horizontal speed"),
    "descent_loss": (0.18, "1 per m/s", "thrust lost when sinking into the own wake"),
    "sticky_motor": (0.035, "1", "dead band and hysteresis of the motor drive"),
    "shifting_payload": (2.0, "mm", "a payload that slides from side to side with the tilt"),
    "roll_yaw_coupling": (0.12, "mN m per (rad/s)", "a yaw torque proportional to roll rate"),
    "sideways_kicks": (60.0, "mN", "short random knocks"),
}


class Strangers:
    """Strengths and states of the unknown causes of one batch: {name: {"strength": (B,), "shape": (4, B)
    uniform draws}}.
    """

    def __init__(self, causes, count):
        self.causes = {name: c for name, c in causes.items() if np.any(c["strength"] != 0)}
        self.count = count
        self.load = None
        self.held = None
        self.slide = np.zeros((2, count))

    def _get(self, name):
        c = self.causes[name]
        return c["strength"], c["shape"]

    def motors(self, u, time, rotor):
        """Effective thrust fraction (4, B) after causes that sit in the motors."""
        if "late_motor_fault" in self.causes:
            s, shape = self._get("late_motor_fault")
            which = np.floor(4 * shape[0]).astype(int)
            since = np.clip((time - (2.5 + 4.0 * shape[1])) / 0.2, 0.0, 1.0)
            factor = np.ones_like(u)
            factor[which, np.arange(self.count)] = 1.0 - s * since
            u = u * factor
        if "thrust_oscillation" in self.causes:
            s, shape = self._get("thrust_oscillation")
            u = u * (1.0 + s * np.sin(2 * np.pi * (3.0 + 6.0 * shape[0]) * time + 6 * shape[1]))
        if "sticky_motor" in self.causes:
            s, _ = self._get("sticky_motor")
            if self.held is None:
                self.held = u.copy()
            moved = u - self.held
            self.held = np.where(np.abs(moved) > s, u - s * np.sign(moved), self.held)
            u = np.where(s > 0, self.held, u)
        return np.clip(u, 0.0, None)

    def wrench(self, time, position, q, velocity, rates, rotor, old_rotor, thrust):
        """Force (3, B) N and torque (3, B) N m in the body frame."""
        force, torque = np.zeros((3, self.count)), np.zeros((3, self.count))
        zero = np.zeros(self.count)
        for name in self.causes:
            s, shape = self._get(name)
            if name == "slung_load":
                force = force + rotate_back(
                    q, self._slung(s * 1e-3, 0.1 + 0.1 * shape[0], position, velocity)
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
                torque = torque + np.stack(
                    [zero, zero, s * 1e-3 * np.sin(2 * np.pi * (0.5 + 1.5 * shape[0]) * time + heading)]
                )
            elif name == "wall_suction":
                radius = np.sqrt(position[0] ** 2 + position[1] ** 2) + 1e-6
                pull = s * 1e-3 * np.exp(-np.maximum(0.75 - radius, 0.0) / 0.18)
                force = force + rotate_back(
                    q, np.stack([pull * position[0] / radius, pull * position[1] / radius, zero])
                )
            elif name == "rotor_precession":
                spin = s * (SPIN[:, None] * -rotor).sum(axis=0)  # angular momentum of the rotors along body z
                spun_up = s * (SPIN[:, None] * (rotor - old_rotor)).sum(axis=0) / 0.001
                torque = torque + np.stack([-rates[1] * spin, rates[0] * spin, spun_up])
                # a case of equal rotors has no net momentum: one pair is heavier
                heavy = 0.6 * s * (rotor[0] + rotor[2]) * (shape[0] - 0.2)
                torque = torque + np.stack([-rates[1] * heavy, rates[0] * heavy, zero])
            elif name == "elastic_tether":
                anchor = np.stack([0.5 * shape[0] - 0.25, 0.5 * shape[1] - 0.25, zero])
                away = position - anchor
                length = np.sqrt((away * away).sum(axis=0)) + 1e-6
                force = force - rotate_back(
                    q, s * 1e-3 * np.maximum(length - 0.3 - 0.3 * shape[2], 0.0) * away / length
                )
            elif name == "translational_lift":
                gain = s * np.minimum(velocity[0] ** 2 + velocity[1] ** 2, 2.5)
                force = force + np.stack([zero, zero, gain * thrust.sum(axis=0)])
            elif name == "descent_loss":
                force = force - np.stack(
                    [zero, zero, s * np.clip(-velocity[2] - 0.1, 0.0, 1.5) * thrust.sum(axis=0)]
                )
            elif name == "shifting_payload":
                tilt = rotate_back(q, np.stack([zero, zero, -np.ones(self.count)]))[:2]
                self.slide = np.clip(
                    self.slide + 0.001 * (6.0 * tilt + 0.3 * np.sin(2.0 * time + 6 * shape[:2])), -1, 1
                )
                c = 1e-3 * s * self.slide
                total = thrust.sum(axis=0)
                torque = torque + np.stack([-c[1] * total, c[0] * total, zero])
            elif name == "roll_yaw_coupling":
                torque = torque + np.stack([zero, zero, s * 1e-3 * rates[0]])
            elif name == "sideways_kicks":
                phase = (time + 10 * shape[0]) / (0.6 + 0.5 * shape[1])
                slot = np.floor(phase)
                angle = 2 * np.pi * ((slot * 0.754877 + shape[2]) % 1.0)
                kick = s * 1e-3 * (phase - slot < 0.08)
                force = force + rotate_back(q, kick * np.stack([np.cos(angle), np.sin(angle), zero]))
        return force, torque

    def _slung(self, mass, length, position, velocity):
        """World force (3, B) of a load on a stiff, damped thread (spring 40 N/m) that cannot push."""
        if self.load is None:
            self.load = [position - np.stack([0.03 + 0 * length, 0 * length, length]), velocity.copy()]
        where, speed = self.load
        safe = np.maximum(mass, 1e-5)
        apart = position - where
        distance = np.sqrt((apart * apart).sum(axis=0)) + 1e-9
        along = apart / distance
        closing = ((velocity - speed) * along).sum(axis=0)
        tension = (
            np.maximum(20.0 * (distance - length) + 0.15 * closing, 0.0) * (distance > length) * (mass > 0)
        )
        tension = np.minimum(tension, 10 * safe * GRAVITY + 0.2 * MASS * GRAVITY)
        acceleration = tension * along / safe
        acceleration[2] -= GRAVITY
        speed = speed + 0.001 * (acceleration - 0.3 * speed)
        where = where + 0.001 * speed
        self.load = [where, speed]
        return -tension * along

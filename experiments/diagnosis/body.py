"""The physics of a batch of vehicles, a millisecond a step: rotors, forces, rigid body and battery.

Integration is semi-implicit with a second-order position; Euler angles appear nowhere. Arrays have
the body index last.
"""

import numpy as np

from experiments.diagnosis import forces, vehicle

DT = 0.001
"""Seconds of a step of the physics."""


class Body:
    """Rotors, forces and the rigid body of a batch; state position, velocity, rates (3, B), q,
    rotor (4, B).
    """

    def __init__(self, p, neutral, position, velocity, q, rates, rotor):
        self.p, self.active = p, forces.Active(p, neutral)
        self.position = position
        self.velocity = velocity
        self.q = q
        self.rates = rates
        self.rotor, self.drive, self.specific = (rotor, rotor.copy(), np.zeros_like(rates))
        self.count = rates.shape[1]
        self.wake = bool(np.any(p["wake"] != 0))
        self.gyroscopes = bool(np.any(p["propeller_inertia"] != 0))
        self.inverse = np.moveaxis(np.linalg.inv(np.moveaxis(p["inertia"], 2, 0)), 0, 2)
        self.diagonal = not np.any(p["inertia"][~np.eye(3, dtype=bool)])
        self.principal = p["inertia"][np.arange(3), np.arange(3)]
        self.arm_x = vehicle.ROTOR_X[:, None] - p["com"][0]
        self.arm_y = vehicle.ROTOR_Y[:, None] - p["com"][1]
        self.up, self.down = (1 - np.exp(-DT / p["tau_up"]), 1 - np.exp(-DT / p["tau_down"]))
        self.second = np.where(
            p["tau_second"] > 0, 1 - np.exp(-DT / np.maximum(p["tau_second"], 1e-4)), 1.0
        )
        self.lifts = p["thrust_constant"] * p["rotor_gain"]
        self.reacts = p["torque_ratio"] * p["torque_gain"] * vehicle.SPIN[:, None] * self.lifts
        self.zero = np.zeros(self.count)

    def step(
        self, m, voltage, load, gust_force, gust_torque, slow, others=(), unknowns=None, time=0.0
    ):
        """One millisecond under motor commands m (4, B); `others` are positions (3, B) of vehicles
        that may fly above.
        """
        p = self.p
        zero = self.zero
        u = forces.motor_demand(p, self.active, m, voltage, load)
        if unknowns:
            unknowns.look(self.position, self.q, self.velocity, self.rates, m, voltage)
            u = unknowns.motors(u, time)
        before = self.rotor
        self.drive = self.drive + self.second * (vehicle.MAX_SPEED * np.sqrt(u) - self.drive)
        share = np.where(self.drive > self.rotor, self.up, self.down)
        self.rotor = self.rotor + share * (self.drive - self.rotor)
        squared = self.rotor * self.rotor
        spinning = self.gyroscopes and p["propeller_inertia"] * vehicle.SPIN[:, None]
        thrust = self.lifts * squared * forces.surface_gain(p, self.active, self.position, self.q)
        moment = np.stack(
            [
                (self.arm_y * thrust).sum(0),
                -(self.arm_x * thrust).sum(0),
                (self.reacts * squared).sum(0),
            ]
        )
        force, torque = forces.air_forces(
            p,
            self.active,
            self.q,
            self.velocity,
            self.rates,
            self.rotor,
            thrust,
            self.position,
            slow,
        )
        force[2] += thrust.sum(axis=0)
        outside = gust_force
        for other in others if self.wake else ():
            pull, gradient = forces.wake_force(p, self.position, other)
            outside = outside + np.stack([zero, zero, pull])
            tilting = np.stack([gradient[1], -gradient[0], zero])
            torque = torque + vehicle.rotate_back(self.q, tilting) * vehicle.ARM**2
        force = force + vehicle.rotate_back(self.q, outside)
        torque = torque + moment + gust_torque
        if unknowns:
            more_force, more_torque = unknowns.wrench(self.q, time)
            force = force + more_force
            torque = torque + more_torque
        if (
            self.gyroscopes
        ):  # what speeds a rotor up turns the body; spinning rotors resist being tilted
            spun = (spinning * self.rotor).sum(0)
            torque = torque + np.stack(
                [
                    self.rates[1] * spun,
                    -self.rates[0] * spun,
                    (spinning * (self.rotor - before)).sum(0) / DT,
                ]
            )
        specific = force / p["mass"]
        accel = vehicle.rotate(self.q, specific)
        accel[2] -= vehicle.GRAVITY
        if self.diagonal:
            turning = (
                torque - vehicle.cross(self.rates, self.principal * self.rates)
            ) / self.principal
        else:
            momentum = np.einsum("ijb,jb->ib", p["inertia"], self.rates)
            turning = np.einsum(
                "ijb,jb->ib", self.inverse, torque - vehicle.cross(self.rates, momentum)
            )
        self.rates = self.rates + DT * turning
        self.position = self.position + DT * self.velocity + 0.5 * DT * DT * accel
        self.velocity = self.velocity + DT * accel
        self.q = vehicle.turn(self.q, self.rates, DT)
        self.specific = specific


class Battery:
    """Voltage (B,) V: open-circuit voltage falls with the charge used, the terminals sag with the
    current.
    """

    def __init__(self, air, hover):
        self.air, self.used, self.load = air, np.zeros(len(hover)), hover.copy()

    def step(self, m, dt):
        current = (m * np.sqrt(m)).mean(axis=0)
        self.used = self.used + dt * current
        self.load = self.load + (dt / 0.04) * (current - self.load)
        air = self.air
        return air["open_voltage"] - air["discharge"] * self.used - air["resistance"] * self.load

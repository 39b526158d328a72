"""The plant: vehicles in the air under commands from anywhere, or along references.

`Flight` is what flies: body (1 kHz), firmware (500 Hz), battery, link and the poses as they are
seen, 2 ms at a time. `fly` commands it with the exam's controllers along references and returns the
true motion. Arrays have the body index last.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from experiments.diagnosis import forces, vehicle
from experiments.diagnosis.body import DT, Battery, Body
from experiments.diagnosis.controllers import Controllers
from experiments.diagnosis.firmware import SAMPLE, Firmware
from experiments.diagnosis.unknowns import Unknowns

PER_TICK = 5
"""Samples in a tick of the off-board controller, 10 ms."""
CLEARANCE = 0.015
"""Metres between a body and the floor or the ceiling: less is a crash."""


@dataclass
class Batch:
    """Everything that decides a batch of B bodies over K ticks of 10 ms."""

    told: list  # B `vehicle.Told`
    parameters: dict  # arrays of `vehicle.nominal_parameters`
    reference: (
        # position, velocity, acceleration (K, 3, B), yaw, yaw_rate (K, B), pulses (K, 4, B)
        dict
    )
    controllers: list  # B names
    partner: np.ndarray  # (B,) index of the vehicle that may fly above; itself if alone
    arrival: (
        np.ndarray
    )  # (K, B) ms at which the command of tick k reaches the vehicle; >= 10**8: lost
    air: dict  # see `sensors.draw_air`
    # site -> [(columns, cause), …], see `unknowns`
    unknowns: dict = field(default_factory=dict)
    # (positions (3, B) below, positions (3, B) of those above) -> where the wakes seem to come from
    wakes_from: Callable = lambda below, above: above


def received(arrival, steps):
    """(steps, B) index of the newest command that has arrived by each ms; -1 before the first."""
    ticks, count = arrival.shape
    table = np.full((steps, count), -1, dtype=np.int32)
    columns = np.arange(count)
    for k in range(ticks):
        inside = arrival[k] < steps
        ms = arrival[k][inside]
        table[ms, columns[inside]] = np.maximum(table[ms, columns[inside]], k)
    return np.maximum.accumulate(table, axis=0)


POSE = {"position": 3, "velocity": 3, "quaternion": 4}
KEPT = {"rates": 3, "specific": 3, "gyro": 3, "rotor": 4, "motor": 4, "integral": 3, "applied": 4}


class Flight:
    """B vehicles in the air, at rest at the start, 2 ms at a time.

    Args:
      told: B `vehicle.Told`.
      parameters: of `vehicle.nominal_parameters`, with causes and nuisances written in.
      air: of `sensors.stack`, for as many ticks as are flown.
      arrival: (K, B) ms at which the command of each tick reaches its vehicle; >=
      10**8: lost.
      position, quaternion: (3, B) m and (4, B) wxyz at the start.
      partners: list of (B,) indices of vehicles that may fly above each body; a body's
      own index: none.
      unknowns: as in `Batch`.
      solids: anything with `stop(position, velocity)`, called after each ms, or None.
      wakes_from: as in `Batch`, called every 2 ms.
    """

    def __init__(
        self,
        told,
        parameters,
        air,
        arrival,
        position,
        quaternion,
        partners=(),
        unknowns=None,
        solids=None,
        wakes_from=lambda below, above: above,
    ):
        ticks, count = arrival.shape
        self.wakes_from = wakes_from
        self.p = parameters
        self.air = air
        self.solids = solids
        self.sample = 0
        hover = np.array([t.hover for t in told])
        self.unknowns = Unknowns(unknowns or {}, count, hover)
        self.received = received(arrival, 10 * ticks)
        self.start = np.concatenate([hover[None], np.zeros((3, count))])
        self.body = Body(
            parameters,
            vehicle.nominal_parameters(told),
            np.array(position, float),
            np.zeros((3, count)),
            np.array(quaternion, float),
            np.zeros((3, count)),
            np.tile(vehicle.MAX_SPEED * np.sqrt(hover), (4, 1)),
        )
        self.body.specific = np.tile([[0.0], [0.0], [vehicle.GRAVITY]], (1, count))
        self.firmware = Firmware(parameters, air["gyro_bias"].astype(float))
        self.battery = Battery(air, hover)
        self.voltage = self.battery.step(np.tile(hover, (4, 1)), 0.0)
        self.commands = np.zeros((ticks, 4, count))
        samples = PER_TICK * ticks
        self.history = {n: np.zeros((samples, size, count), np.float32) for n, size in POSE.items()}
        self.columns = np.arange(count)
        far = np.array([[0.0], [0.0], [-10.0]])
        self.partners = [
            (partner, np.where(partner == self.columns, far, 0.0)) for partner in partners
        ]

    def look(self):
        """Sample the sensors: the pose into `history`, the firmware's gyroscope into `gyro`. Once
        before each `step`.
        """
        s = self.sample
        body = self.body
        for name, kept in self.history.items():
            kept[s] = body.q if name == "quaternion" else getattr(body, name)
        seen = self.p["gyro_gain"] * body.rates + self.air["gyro_bias"] + self.air["gyro"][s]
        self.gyro = self.firmware.gyro_filter(seen)

    def seen(self):
        """Position (3, B), quaternion (4, B) and velocity (3, B) as the motion capture gives them
        now, late and noisy.
        """
        p = self.p
        air = self.air
        s = self.sample
        k = self.sample // PER_TICK
        late = air["pose_delay"] + p["pose_delay"] + p["pose_jitter"] * air["pose_jitter"][k]
        back = np.clip(np.maximum(late, 0.0) / 2.0, 0.0, s)
        whole = back.astype(int)
        rest = back - whole

        def past(name):
            newer = self.history[name][s - whole, :, self.columns].T.astype(float)
            older = self.history[name][np.maximum(s - whole - 1, 0), :, self.columns].T
            return newer + rest * (older - newer)

        q = vehicle.multiply(past("quaternion"), air["seen_attitude"][k])
        q /= np.sqrt((q * q).sum(axis=0))
        return (
            past("position") + air["seen_position"][k],
            q,
            past("velocity") + air["seen_velocity"][k],
        )

    def send(self, command):
        """Issue this tick's command (4, B): thrust 0..1 and body rates rad/s."""
        self.commands[self.sample // PER_TICK] = command

    def step(self):
        """Two milliseconds after `look`; returns the command in force and the motor commands (4,
        B).
        """
        s = self.sample
        k = self.sample // PER_TICK
        air = self.air
        index = self.received[2 * s]
        now = np.where(
            index >= 0, self.commands[np.maximum(index, 0), :, self.columns].T, self.start
        )
        m = self.firmware(now, self.gyro)
        self.voltage = self.battery.step(m, SAMPLE)
        gusts = [air[name][k] for name in ("gust_force", "gust_torque", "slow")]
        here = self.body.position
        others = [self.wakes_from(here, here[:, i] + away) for i, away in self.partners]
        for half_step in range(2):
            now_s = SAMPLE * s + DT * half_step
            self.body.step(m, self.voltage, self.battery.load, *gusts, others, self.unknowns, now_s)
            if self.solids is not None:
                self.solids.stop(self.body.position, self.body.velocity)
        self.sample += 1
        return now, m


def fly(batch):
    """Fly the batch: dict of true signals every 2 ms, (S, n, B) float32, and commands (K, 4, B) as
    issued.

    `gyro` is the firmware's gyroscope (bias, noise, filter), `applied` the command in force,
    `motor` what the firmware asks for in the 2 ms from that sample on; `voltage` (S, B); `crashed`
    (B,) sample of the first breach (floor, ceiling, tilt above 85 degrees, 2.5 m away), S if none.
    """
    p = batch.parameters
    reference = batch.reference
    ticks, _, count = reference["position"].shape
    mass = np.array([t.mass for t in batch.told])
    most = np.array([4 * t.thrust_constant * vehicle.MAX_SPEED**2 for t in batch.told])
    control = Controllers(batch.controllers, mass, most, reference)
    half = 0.5 * reference["yaw"][0]
    q = np.stack([np.cos(half), np.zeros(count), np.zeros(count), np.sin(half)])
    flight = Flight(
        batch.told,
        p,
        batch.air,
        batch.arrival,
        reference["position"][0],
        q,
        [batch.partner],
        batch.unknowns,
        wakes_from=batch.wakes_from,
    )
    body = flight.body
    samples = PER_TICK * ticks
    out = {name: np.zeros((samples, size, count), np.float32) for name, size in KEPT.items()}
    out |= {name: np.zeros((samples, count), np.float32) for name in ("voltage", "load")}
    crashed = np.full(count, samples)
    lever = bool(np.any(p["imu_lever"] != 0))

    for s in range(samples):
        k, part = divmod(s, PER_TICK)
        if part == 0:
            bad = (body.position[2] < CLEARANCE) | (
                1 - 2 * (body.q[1] ** 2 + body.q[2] ** 2) < 0.087
            )
            bad |= body.position[2] > vehicle.CEILING - CLEARANCE
            bad |= ((body.position**2).sum(axis=0) > 2.5**2) | ~np.isfinite(body.position[0])
            crashed = np.where(bad & (crashed == samples), s, crashed)
            dead = crashed < samples
            # parked, so that one wreck does not spoil the arithmetic of the batch
            if dead.any():
                body.position[:, dead], body.velocity[:, dead] = (
                    reference["position"][k][:, dead],
                    0.0,
                )
                body.rates[:, dead], body.q[:, dead] = (0.0, np.array([[1.0], [0], [0], [0]]))
        flight.look()
        specific = (
            forces.seen_by_accelerometer(p, body.specific, body.rates) if lever else body.specific
        )
        now = {"rates": body.rates, "specific": specific, "gyro": flight.gyro, "rotor": body.rotor}
        now |= {
            "integral": flight.firmware.integral,
            "voltage": flight.voltage,
            "load": flight.battery.load,
        }
        for name, value in now.items():
            out[name][s] = value
        if part == 0:
            flight.send(control(k, *flight.seen()))
        out["applied"][s], out["motor"][s] = flight.step()
    out |= flight.history
    out["command"], out["crashed"] = flight.commands.astype(np.float32), crashed
    out["pose_delay"], out["pose_jitter"] = (1e-3 * p["pose_delay"], 1e-3 * p["pose_jitter"])
    return out

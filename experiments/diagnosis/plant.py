"""The plant: quadrotors at 1 kHz under a firmware rate loop at 500 Hz with its filters and an
off-board controller.

Bodies are integrated as one batch (NumPy, body index last). `Body` is the physics alone; `measure`
steps it over short windows. `Flight` is what flies: body, firmware, battery, link and the poses as
they are seen, 2 ms at a time, under commands from anywhere. `fly` commands it with the exam's
controllers along references and returns the true motion. Euler angles appear nowhere in the
physics; integration is semi-implicit with a second-order position.
"""

from dataclasses import dataclass, field

import numpy as np

from experiments.diagnosis import effects, vehicle
from experiments.diagnosis.controllers import Controllers
from experiments.diagnosis.unknowns import Unknowns

DT = 0.001
SAMPLE = 0.002  # s, at which the truth is kept and the rate loop runs
PER_TICK = 5  # samples in a tick of the off-board controller, 10 ms
CLEARANCE = 0.015  # m, between the body and the floor or the ceiling: less is a crash


@dataclass
class Batch:
    """Everything that decides a batch of B bodies over K ticks of 10 ms."""

    told: list  # B `vehicle.Told`
    parameters: dict  # arrays of `vehicle.nominal_parameters`
    reference: (
        dict  # position, velocity, acceleration (K, 3, B), yaw, yaw_rate (K, B), pulses (K, 4, B)
    )
    controllers: list  # B names
    partner: np.ndarray  # (B,) index of the vehicle that may fly above; itself if alone
    arrival: (
        np.ndarray
    )  # (K, B) ms at which the command of tick k reaches the vehicle; >= 10**8: lost
    air: dict  # see `sensors.draw_air`
    unknowns: dict = field(default_factory=dict)  # site -> [(columns, cause), …], see `unknowns`


class Filter:
    """Second-order Butterworth low-pass of (n, B) signals at 500 Hz; `cut` (B,) Hz, 0 lets
    everything through.
    """

    def __init__(self, cut, rows, start):
        on = cut > 0
        k = np.tan(np.pi * np.where(on, cut, 1.0) * SAMPLE)
        scale = 1.0 / (1.0 + np.sqrt(2.0) * k + k * k)
        self.b0 = np.where(on, k * k * scale, 1.0)
        self.b1, self.b2 = (np.where(on, c * k * k * scale, 0.0) for c in (2, 1))
        self.a1 = np.where(on, 2 * (k * k - 1) * scale, 0.0)
        self.a2 = np.where(on, (1 - np.sqrt(2.0) * k + k * k) * scale, 0.0)
        self.any = bool(on.any())
        self.one = np.broadcast_to(start, (rows, len(cut))) * (1 - self.b0)
        self.two = np.broadcast_to(start, (rows, len(cut))) * (self.b2 - self.a2)

    def __call__(self, x):
        if not self.any:
            return x
        y = self.b0 * x + self.one
        self.one = self.b1 * x - self.a1 * y + self.two
        self.two = self.b2 * x - self.a2 * y
        return y


class Firmware:
    """Rate loop of the firmware at 500 Hz: filters of gyroscope and derivative, PID in counts,
    mixer.
    """

    def __init__(self, p, gyro, integral=None):
        self.p = p
        count = gyro.shape[1]
        self.limit = vehicle.INTEGRAL_LIMIT[:, None]
        self.integral = np.zeros((3, count)) if integral is None else integral.copy()
        self.gyro_filter = Filter(p["gyro_cut"], 3, gyro)
        self.slope_filter = Filter(p["derivative_cut"], 3, 0.0)
        self.keep = np.where(
            p["d_filter"] > 0, np.exp(-SAMPLE / np.maximum(p["d_filter"], 1e-6)), 0.0
        )
        self.slow = bool(self.keep.any())
        self.previous, self.slope = gyro.copy(), np.zeros((3, count))

    def __call__(self, command, gyro):
        """Motor commands (4, B) from the command in force (4, B) and the filtered gyroscope (3,
        B).
        """
        p = self.p
        error = np.rad2deg(command[1:] - gyro)
        self.integral = np.minimum(
            np.maximum(self.integral + SAMPLE * error, -self.limit), self.limit
        )
        slope = self.slope_filter(np.rad2deg(self.previous - gyro) / SAMPLE)
        self.slope = self.keep * self.slope + (1 - self.keep) * slope if self.slow else slope
        self.previous = gyro
        return vehicle.mix(
            command[0], p["kp"] * error + p["ki"] * self.integral + p["kd"] * self.slope
        )


class Body:
    """Rotors, forces and the rigid body of a batch; state position, velocity, rates (3, B), q,
    rotor (4, B).
    """

    def __init__(self, p, neutral, position, velocity, q, rates, rotor):
        self.p, self.active = p, effects.Active(p, neutral)
        self.position = position
        self.velocity = velocity
        self.q = q
        self.rates = rates
        self.rotor, self.drive, self.specific = rotor, rotor.copy(), np.zeros_like(rates)
        self.count = rates.shape[1]
        self.wake = bool(np.any(p["wake"] != 0))
        self.gyroscopes = bool(np.any(p["propeller_inertia"] != 0))
        self.inverse = np.moveaxis(np.linalg.inv(np.moveaxis(p["inertia"], 2, 0)), 0, 2)
        self.diagonal = not np.any(p["inertia"][~np.eye(3, dtype=bool)])
        self.principal = p["inertia"][np.arange(3), np.arange(3)]
        self.arm_x = vehicle.ROTOR_X[:, None] - p["com"][0]
        self.arm_y = vehicle.ROTOR_Y[:, None] - p["com"][1]
        self.up, self.down = 1 - np.exp(-DT / p["tau_up"]), 1 - np.exp(-DT / p["tau_down"])
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
        u = effects.motor_demand(p, self.active, m, voltage, load)
        if unknowns:
            unknowns.look(self.position, self.q, self.velocity, self.rates, m, voltage)
            u = unknowns.motors(u, time)
        before = self.rotor
        self.drive = self.drive + self.second * (vehicle.MAX_SPEED * np.sqrt(u) - self.drive)
        share = np.where(self.drive > self.rotor, self.up, self.down)
        self.rotor = self.rotor + share * (self.drive - self.rotor)
        squared = self.rotor * self.rotor
        spinning = self.gyroscopes and p["propeller_inertia"] * vehicle.SPIN[:, None]
        thrust = self.lifts * squared * effects.surface_gain(p, self.active, self.position, self.q)
        moment = np.stack(
            [
                (self.arm_y * thrust).sum(0),
                -(self.arm_x * thrust).sum(0),
                (self.reacts * squared).sum(0),
            ]
        )
        force, torque = effects.air_forces(
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
            pull, gradient = effects.wake_force(p, self.position, other)
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
      arrival: (K, B) ms at which the command of each tick reaches its vehicle; >= 10**8: lost.
      position, quaternion: (3, B) m and (4, B) wxyz at the start.
      partners: list of (B,) indices of vehicles that may fly above each body; a body's own index:
      none.
      unknowns: as in `Batch`.
      solids: anything with `stop(position, velocity)`, called after each ms, or None.
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
    ):
        ticks, count = arrival.shape
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
        others = [self.body.position[:, partner] + away for partner, away in self.partners]
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
            if dead.any():  # parked, so that one wreck does not spoil the arithmetic of the batch
                body.position[:, dead], body.velocity[:, dead] = (
                    reference["position"][k][:, dead],
                    0.0,
                )
                body.rates[:, dead], body.q[:, dead] = 0.0, np.array([[1.0], [0], [0], [0]])
        flight.look()
        specific = (
            effects.seen_by_accelerometer(p, body.specific, body.rates) if lever else body.specific
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
    out["pose_delay"], out["pose_jitter"] = 1e-3 * p["pose_delay"], 1e-3 * p["pose_jitter"]
    return out

"""The withheld plant as a world: bodies that take a command every 10 ms; 1 kHz inside, no code of the simulator.

`plant.fly` follows references with its own controller from take-off to landing. A game needs the next state
before it knows the next command, a speed limit after each tick and solid things. So the plant's parts are put
together here once more, one tick at a time; tests hold every tick to `plant.fly`.
"""

from dataclasses import dataclass

import numpy as np

from experiments.withheld import body as b
from experiments.withheld import causes, plant, plant_effects, sensors
from experiments.withheld.cases import case_rng
from experiments.worlds.world import Poses, per_world
from openjax.pursuit import Task
from openjax.vehicle import DroneState

RADIUS = 0.05  # m, the solid sphere of a drone
PILLAR_RADIUS, PILLAR_HEIGHT = 0.1, 1.2  # m
SUBSTEPS = 10  # of plant.DT in a tick


@dataclass
class Solids:
    """What can't be flown through: floor, pillars, and the other bodies of the same world.

    pillar (2, P, B) m and active (P, B) are those of each body's world; bodies of a world are neighbours in the
    last axis, `team` of them. Impacts are inelastic and without friction, as in `openjax.vehicle`.
    """

    pillar: np.ndarray
    active: np.ndarray
    team: int

    def stop(self, position, velocity):
        """Push bodies (3, B) out of what they touch, and take the approaching part of their velocity, in place."""
        low = position[2] < RADIUS
        if low.any():
            position[2, low] = RADIUS
            velocity[2, low] = np.maximum(velocity[2, low], 0.0)
        away = position[:2, None] - self.pillar
        distance = np.sqrt((away * away).sum(axis=0)) + 1e-12
        gap = distance - PILLAR_RADIUS - RADIUS
        hit = self.active & (gap < 0.0) & (position[2] < PILLAR_HEIGHT)
        for k, i in zip(*np.nonzero(hit), strict=True):
            normal = away[:, k, i] / distance[k, i]
            position[:2, i] -= gap[k, i] * normal
            velocity[:2, i] -= min(normal @ velocity[:2, i], 0.0) * normal
        for shift in range(1, self.team):
            # each body and the one `shift` further in its world; pairs come once
            worlds = position.reshape(3, -1, self.team)
            between = worlds[:, :, shift:] - worlds[:, :, : self.team - shift]
            apart = np.sqrt((between * between).sum(axis=0))
            for w, j in zip(*np.nonzero(apart < 2 * RADIUS), strict=True):
                one, other = w * self.team + j, w * self.team + j + shift
                normal = between[:, w, j] / max(apart[w, j], 1e-9)
                closing = min(normal @ (velocity[:, other] - velocity[:, one]), 0.0)
                half = 0.5 * (2 * RADIUS - apart[w, j])
                for body, sign in ((one, -1.0), (other, 1.0)):
                    position[:, body] += sign * half * normal
                    velocity[:, body] -= sign * 0.5 * closing * normal


class Air:
    """B bodies in the plant's air at the start of tick 0, rotors at hover.

    Args:
      parameters: of `body.nominal_parameters`, with causes written in.
      noise: of `sensors.stack`, for as many ticks as are flown.
      arrival: (K, B) ms at which the command of each tick reaches its vehicle; >= 10**8: lost.
      position, quaternion: (3, B) m and (4, B) wxyz at the start, at rest.
      partners: list of (B,) indices of vehicles that may fly above each body.
      solids: what is solid, or None.
    """

    def __init__(self, parameters, noise, arrival, position, quaternion, partners=(), solids=None):
        self.p, self.noise, self.partners, self.solids = parameters, noise, partners, solids
        count = position.shape[1]
        self.count, self.tick = count, 0
        self.active = plant_effects.Active(parameters, b.nominal_parameters(count))
        self.received = plant._received(arrival, SUBSTEPS * len(arrival))
        self.position, self.q = np.array(position, float), np.array(quaternion, float)
        self.velocity, self.rates = np.zeros((3, count)), np.zeros((3, count))
        hover = b.MASS * b.GRAVITY / (4 * b.MAX_THRUST)
        self.rotor = np.full((4, count), b.MAX_SPEED * np.sqrt(hover))
        self.drive, self.m = self.rotor.copy(), np.full((4, count), hover)
        self.integral, self.slope = np.zeros((3, count)), np.zeros((3, count))
        self.previous_gyro = np.zeros((3, count))
        self.start = np.concatenate([np.full((1, count), hover), np.zeros((3, count))])
        self.commands = np.zeros((len(arrival), 4, count))
        self.load, self.used = np.full(count, hover), np.zeros(count)
        self.voltage = noise["open_voltage"] - noise["resistance"] * hover
        self.ring = {
            name: np.repeat(value[None], plant.RING, 0)
            for name, value in (("p", self.position), ("q", self.q), ("v", self.velocity))
        }
        p = parameters
        self.inertia_inverse = np.moveaxis(np.linalg.inv(np.moveaxis(p["inertia"], 2, 0)), 0, 2)
        self.up_lag, self.down_lag = (1 - np.exp(-plant.DT / p[name]) for name in ("tau_up", "tau_down"))
        second = 1 - np.exp(-plant.DT / np.maximum(p["tau_second"], 1e-4))
        self.second_lag = np.where(p["tau_second"] > 0, second, 1.0)
        keep = np.exp(-0.002 / np.maximum(p["d_filter"], 1e-6))
        self.slope_keep = np.where(p["d_filter"] > 0, keep, 0.0)

    def measure(self):
        """Position (3, B), quaternion (4, B) and velocity (3, B) as the motion capture gives them at this tick."""
        n, noise = SUBSTEPS * self.tick, self.noise
        k = min(self.tick, len(noise["position"]) - 1)
        self._remember(n)
        late = noise["mocap_delay"] + noise["mocap_jitter"][k]
        late = late + self.p["pose_delay"] + self.p["pose_jitter"] * noise["pose_jitter"][k]
        late = np.clip(late, 0.0, plant.RING - 3.0)
        whole = np.floor(late).astype(int)
        part, columns = late - whole, np.arange(self.count)

        def seen(name):
            newer = self.ring[name][(n - whole) % plant.RING, :, columns].T
            older = self.ring[name][(n - whole - 1) % plant.RING, :, columns].T
            return newer + part * (older - newer)

        quaternion = b.multiply(seen("q"), noise["attitude"][k])
        quaternion /= np.sqrt((quaternion * quaternion).sum(axis=0))
        return seen("p") + noise["position"][k], quaternion, seen("v") + noise["velocity"][k]

    def fly(self, command, max_speed=None):
        """Ten milliseconds after sending `command` (4, B); the speed's norm is cut to `max_speed` (m/s) at the end."""
        k = self.tick
        self.commands[k] = command
        for sub in range(SUBSTEPS):
            n = SUBSTEPS * k + sub
            self._remember(n)
            if sub % 2 == 0:
                self._rate_loop(n)
            self._rotors()
            self._move(k)
            if self.solids is not None:
                self.solids.stop(self.position, self.velocity)
        if max_speed is not None:
            speed = np.sqrt((self.velocity * self.velocity).sum(axis=0)) + 1e-12
            self.velocity *= np.minimum(1.0, max_speed / speed)
        self.tick += 1

    def _remember(self, n):
        for name, value in (("p", self.position), ("q", self.q), ("v", self.velocity)):
            self.ring[name][n % plant.RING] = value

    def _rate_loop(self, n):
        """The firmware's rate controller, 500 Hz, on the noisy gyroscope."""
        p, index = self.p, self.received[n]
        now = np.where(
            index >= 0, self.commands[np.maximum(index, 0), :, np.arange(self.count)].T, self.start
        )
        gyro = self.rates + self.noise["gyro_bias"] + self.noise["gyro_loop"][n // 2]
        error = np.rad2deg(now[1:] - gyro)
        limit = b.INTEGRAL_LIMIT[:, None]
        self.integral = np.clip(self.integral + 0.002 * error, -limit, limit)
        slope = -np.rad2deg(gyro - self.previous_gyro) / 0.002
        self.slope = self.slope_keep * self.slope + (1 - self.slope_keep) * slope
        self.previous_gyro = gyro
        self.m = b.mix(now[0], p["kp"] * error + p["ki"] * self.integral + p["kd"] * self.slope)

    def _rotors(self):
        """Battery and motors over one substep."""
        p, noise, m = self.p, self.noise, self.m
        current = (m * np.sqrt(m)).sum(axis=0) * 0.25
        self.used = self.used + plant.DT * current
        self.load = self.load + (plant.DT / 0.04) * (current - self.load)
        self.voltage = (
            noise["open_voltage"] - noise["discharge"] * self.used - noise["resistance"] * self.load
        )
        demand = plant_effects.motor_demand(p, self.active, m, self.voltage, self.load)
        self.drive = self.drive + self.second_lag * (b.MAX_SPEED * np.sqrt(demand) - self.drive)
        lag = np.where(self.drive > self.rotor, self.up_lag, self.down_lag)
        self.rotor = self.rotor + lag * (self.drive - self.rotor)

    def _move(self, k):
        """Forces and the rigid body over one substep."""
        p, active, noise = self.p, self.active, self.noise
        position, velocity, q, rates = self.position, self.velocity, self.q, self.rates
        zero = np.zeros(self.count)
        squared = b.THRUST_CONSTANT * self.rotor * self.rotor * p["rotor_gain"]
        thrust = squared * plant_effects.surface_gain(p, active, position, q)
        arm_x, arm_y = b.ROTOR_X[:, None] - p["com"][0], b.ROTOR_Y[:, None] - p["com"][1]
        reaction = p["torque_ratio"] * p["torque_gain"] * (b.SPIN[:, None] * squared).sum(0)
        moment = np.stack([(arm_y * thrust).sum(0), -(arm_x * thrust).sum(0), reaction])
        air_force, air_torque = plant_effects.air_forces(
            p, active, q, velocity, rates, self.rotor, thrust, position, noise["slow"][k]
        )
        force = np.stack([zero, zero, thrust.sum(0)]) + air_force
        moment = moment + air_torque + noise["gust_torque"][k]
        outside = noise["gust_force"][k]
        if active("wake"):
            for partner in self.partners:
                pull, gradient = plant_effects.wake_force(p, position, partner)
                outside = outside + np.stack([zero, zero, pull])
                turn = b.rotate_back(q, np.stack([gradient[1], -gradient[0], zero]))
                moment = moment + turn * b.ARM**2
        force = force + b.rotate_back(q, outside)
        accel = b.rotate(q, force / p["mass"])
        accel[2] -= b.GRAVITY
        momentum = np.einsum("ijb,jb->ib", p["inertia"], rates)
        turning = np.einsum("ijb,jb->ib", self.inertia_inverse, moment - b.cross(rates, momentum))
        self.rates = rates + plant.DT * turning
        self.position = position + plant.DT * velocity + 0.5 * plant.DT**2 * accel
        self.velocity = velocity + plant.DT * accel
        self.q = b.turn(q, self.rates, plant.DT)


class PlantWorld:
    """Vehicles of the withheld plant, each with its own noise and all with the same cause, or none.

    Args:
      drones: (W, N, ...) at the start.
      tasks: (W, ...), for their pillars.
      ticks: control steps to be flown at most.
      seed, number: of the case: its sensors and cause.
      cause: of `withheld.causes`, or None.
      first: number of the first episode, from which its noise is drawn.
    """

    def __init__(
        self,
        drones: DroneState,
        tasks: Task,
        ticks: int,
        seed: int,
        number: int = 0,
        cause: dict | None = None,
        first: int = 0,
    ):
        worlds, self.team = drones.position.shape[:2]
        count = worlds * self.team
        shared = sensors.draw_case(case_rng(seed, number, 1))
        noises = []
        for world in range(worlds):
            rng = case_rng(seed, number, 3, first + world)
            voltage = shared["voltage"] + rng.uniform(-0.25, 0.15)
            for _ in range(self.team):
                drawn = sensors.draw_flight(rng, shared, ticks, voltage + rng.uniform(-0.02, 0.02))
                noises.append({name: value for name, value in drawn.items() if name not in ("gyro", "accel")})
        parameters = b.nominal_parameters(count)
        parameters["rotor_gain"] *= 1 + shared["thrust_offset"]
        arrival = np.repeat(10.0 * np.arange(ticks)[:, None], count, axis=1)
        if cause is not None:
            causes.apply(cause, parameters, np.arange(count), arrival, case_rng(seed, number, 4, first))
        index = np.arange(count).reshape(worlds, self.team)
        self.air = Air(
            parameters,
            sensors.stack(noises),
            arrival,
            np.asarray(drones.position, float).reshape(count, 3).T,
            np.asarray(drones.quaternion, float).reshape(count, 4).T,
            partners=[np.roll(index, -shift, axis=1).ravel() for shift in range(1, self.team)],
            solids=solids_of(tasks, self.team),
        )

    def poses(self) -> Poses:
        """Where the vehicles are."""
        return per_world(self.team, self.air.position, self.air.q, self.air.velocity)

    def measure(self) -> Poses:
        """Where the motion capture sees them."""
        return per_world(self.team, *self.air.measure())

    def fly(self, command, max_speed=None) -> None:
        """One tick."""
        self.air.fly(command.reshape(-1, 4).T, max_speed)


def solids_of(tasks: Task, team: int) -> Solids:
    """What is solid in the worlds of `tasks`, for bodies of teams that are neighbours."""
    pillars = np.asarray(tasks.pillar_position, float)  # (W, P, 2)
    return Solids(
        pillar=np.repeat(np.moveaxis(pillars, (0, 1, 2), (2, 1, 0)), team, axis=2),
        active=np.repeat(np.asarray(tasks.pillar_active).T, team, axis=1),
        team=team,
    )

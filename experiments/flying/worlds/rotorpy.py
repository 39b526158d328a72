"""RotorPy 3 as a world (Folk, Paulos, Kumar 2023; the `dev` extra): its `Multirotor`
and its own Crazyflie.

Rigid body, rotors, drag at the hubs and motor lag are RotorPy's, with its identified
Crazyflie: 30 g, motors of 72 ms, other thrust and torque constants. RotorPy integrates
one vehicle at a time; `Bodies` evaluates the same equations for all at once, and a test
holds it against `Multirotor.step`. The firmware's rate loop at 500 Hz and the sensors'
noise are those of the exam's plant, since RotorPy's Crazyflie has no motor commands;
commanded thrust is in units of the nominal vehicle's.
"""

import numpy as np

from experiments.diagnosis import vehicle as v
from experiments.diagnosis.firmware import SAMPLE, Firmware
from experiments.diagnosis.plant import PER_TICK
from experiments.diagnosis.rotorpy_flights import hubs
from experiments.flying.worlds.game import Poses, per_world
from experiments.flying.worlds.plant import air_of, sensors_of, solids_of
from openjax.pursuit import Task
from openjax.vehicle import DroneState

MOST_THRUST = v.THRUST_CONSTANT * v.MAX_SPEED**2  # N, of a nominal rotor


def crazyflie() -> dict:
    """RotorPy's Crazyflie, with its rotors numbered and turning as the firmware has
    them.
    """
    from rotorpy.vehicles.crazyflie_params import quad_params

    return quad_params | {"rotor_pos": hubs(), "rotor_directions": v.SPIN}


class Bodies:
    """What `Multirotor.step` does, for B vehicles at once: its equations with its
    numbers, by a Runge-Kutta step.

    Args:
      model: RotorPy's `Multirotor`, with or without aerodynamics; wind and ground
      aren't known here.
      state: {"x": (3, B), "v": (3, B), "q": (4, B) as xyzw, "w": (3, B),
      "rotor_speeds": (4, B)}.
    """

    def __init__(self, model, state: dict[str, np.ndarray]):
        self.model = model
        self.state = np.concatenate([state[name] for name in ("x", "v", "q", "w", "rotor_speeds")])

    @property
    def position(self) -> np.ndarray:
        """(3, B) m, a view."""
        return self.state[0:3]

    @property
    def velocity(self) -> np.ndarray:
        """(3, B) m/s, a view."""
        return self.state[3:6]

    @property
    def quaternion(self) -> np.ndarray:
        """(4, B) wxyz."""
        return np.roll(self.state[6:10], 1, axis=0)

    @property
    def rates(self) -> np.ndarray:
        """(3, B) rad/s, a view."""
        return self.state[10:13]

    def step(self, speeds: np.ndarray, time: float) -> None:
        """`time` s under commanded motor speeds (4, B) in rad/s."""
        least = self.model.rotor_speed_min
        most = self.model.rotor_speed_max
        speeds = np.clip(speeds, least, most)
        s = self.state
        one = self._slope(s, speeds)
        two = self._slope(s + 0.5 * time * one, speeds)
        three = self._slope(s + 0.5 * time * two, speeds)
        four = self._slope(s + time * three, speeds)
        s = s + time / 6.0 * (one + 2.0 * (two + three) + four)
        s[6:10] /= np.sqrt((s[6:10] ** 2).sum(axis=0))
        s[13:] = np.clip(s[13:], least, most)
        self.state = s

    def _slope(self, s, speeds):
        model = self.model
        q = s[6:10]
        rates = s[10:13]
        rotor = s[13:]
        attitude = np.roll(q / np.sqrt((q * q).sum(axis=0)), 1, axis=0)
        hubs = model.rotor_geometry  # (4, 3)
        force = np.zeros((3, 4, s.shape[1]))  # of each rotor, in the body frame
        force[2] = model.k_eta * rotor**2
        torque = np.zeros((3, s.shape[1]))
        torque[2] = model.k_m * (model.rotor_dir @ rotor**2)
        drag = 0.0
        if model.aero:
            air = v.rotate_back(attitude, s[3:6])
            at_hubs = air[:, None] + np.cross(rates[:, None], hubs.T[:, :, None], axis=0)
            drag = -np.sqrt((air * air).sum(axis=0)) * (model.drag_matrix @ air)
            force -= rotor * np.einsum("ij,jrb->irb", model.rotor_drag_matrix, at_hubs)
            force[2] += model.k_h * (at_hubs[0] ** 2 + at_hubs[1] ** 2)
            torque += -model.k_flap * (
                rotor * np.stack([at_hubs[1], -at_hubs[0], 0.0 * rotor])
            ).sum(axis=1)
        torque += np.cross(hubs.T[:, :, None], force, axis=0).sum(axis=1)
        total = v.rotate(attitude, force.sum(axis=1) + drag)
        total[2] -= model.mass * model.g
        spin = np.cross(rates, model.inertia @ rates, axis=0)
        x, y, z, w = q
        p, q_, r = rates
        turn = 0.5 * np.stack(
            [
                w * p - z * q_ + y * r,
                z * p + w * q_ - x * r,
                -y * p + x * q_ + w * r,
                -x * p - y * q_ - z * r,
            ]
        )
        accelerations = [total / model.mass, turn, model.inv_inertia @ (torque - spin)]
        return np.concatenate([s[3:6], *accelerations, (speeds - rotor) / model.tau_m])


class RotorPyWorld:
    """Vehicles of RotorPy.

    Args:
      drones: (W, N, ...) at the start.
      tasks: (W, ...), for their pillars.
      ticks: control steps to be flown at most.
      seed: of the sensors' noise.
      first: number of the first episode, from which its noise is drawn.
    """

    def __init__(self, drones: DroneState, tasks: Task, ticks: int, seed: int, first: int = 0):
        worlds, self.team = drones.position.shape[:2]
        count = worlds * self.team
        quaternion = np.asarray(drones.quaternion, float).reshape(count, 4).T
        start = {
            "x": np.asarray(drones.position, float).reshape(count, 3).T,
            "v": np.zeros((3, count)),
            "q": np.roll(quaternion, -1, axis=0),
            "w": np.zeros((3, count)),
        }
        firmware = v.nominal_parameters([v.Told()] * count)
        self.bodies = self.make_bodies(start, firmware)
        sensors_drawn = sensors_of(seed, 0)
        self.air = air_of(
            sensors_drawn, seed, 0, ticks + 1, range(first, first + worlds), self.team
        )
        self.firmware = Firmware(firmware, self.air["gyro_bias"].astype(float))
        self.solids = solids_of(tasks, self.team)
        self.tick = 0

    def make_bodies(self, start, firmware) -> Bodies:
        """The bodies, which hover at `start`; another vehicle's gains are written into
        `firmware`.
        """
        from rotorpy.vehicles.multirotor import Multirotor

        model = Multirotor(crazyflie(), control_abstraction="cmd_motor_speeds", aero=True)
        hover = np.sqrt(model.mass * v.GRAVITY / (4 * model.k_eta))
        return Bodies(model, start | {"rotor_speeds": np.full((4, start["x"].shape[1]), hover)})

    def speeds(self, motors) -> np.ndarray:
        """The rotors' speeds at which motor commands (4, B) settle."""
        return np.sqrt(motors * MOST_THRUST / self.bodies.model.k_eta)

    def poses(self) -> Poses:
        """Where the vehicles are."""
        return per_world(
            self.team, self.bodies.position, self.bodies.quaternion, self.bodies.velocity
        )

    def measure(self) -> Poses:
        """Where the motion capture sees them."""
        air = self.air
        k = self.tick
        bodies = self.bodies
        delay = 1e-3 * air["pose_delay"]
        quaternion = v.multiply(
            v.turn(bodies.quaternion, -bodies.rates, delay), air["seen_attitude"][k]
        )
        quaternion /= np.sqrt((quaternion * quaternion).sum(axis=0))
        position = bodies.position - delay * bodies.velocity + air["seen_position"][k]
        return per_world(self.team, position, quaternion, bodies.velocity + air["seen_velocity"][k])

    def fly(self, command) -> None:
        """One tick: five times the rate loop and RotorPy's equations, then solid
        things.
        """
        command = command.reshape(-1, 4).T
        for part in range(PER_TICK):
            noise = self.air["gyro_bias"] + self.air["gyro"][PER_TICK * self.tick + part]
            self.motors = self.firmware(command, self.bodies.rates + noise)
            self.bodies.step(self.speeds(self.motors), SAMPLE)
        self.solids.stop(self.bodies.position, self.bodies.velocity)
        self.tick += 1

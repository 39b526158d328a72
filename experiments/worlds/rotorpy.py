"""RotorPy 3 as a world (Folk, Paulos, Kumar 2023; the `dev` extra): its `Multirotor` and its own Crazyflie.

Rigid body, rotors, drag at the hubs and motor lag are RotorPy's, with its identified Crazyflie: 30 g, motors of 72 ms,
other thrust and torque constants. The firmware's rate loop at 500 Hz and the sensors' noise are those of the exam's
plant, since RotorPy's Crazyflie has no motor commands; commanded thrust is in units of the nominal vehicle's.
"""

import numpy as np

from experiments.exam import vehicle as v
from experiments.exam.plant import PER_TICK, SAMPLE, Firmware
from experiments.worlds.plant import air_of, limit_speed, sensors_of, solids_of
from experiments.worlds.world import Poses, per_world
from openjax.pursuit import Task
from openjax.vehicle import DroneState

MOST_THRUST = v.THRUST_CONSTANT * v.MAX_SPEED**2  # N, of a nominal rotor


def crazyflie() -> dict:
    """RotorPy's Crazyflie, with its rotors numbered and turning as the firmware has them."""
    from rotorpy.vehicles.crazyflie_params import quad_params

    hubs = {f"r{i + 1}": np.array([v.ROTOR_X[i], v.ROTOR_Y[i], 0.0]) for i in range(4)}
    return quad_params | {"rotor_pos": hubs, "rotor_directions": v.SPIN}


class RotorPyWorld:
    """Vehicles of RotorPy, one `Multirotor` each.

    Args:
      drones: (W, N, ...) at the start.
      tasks: (W, ...), for their pillars.
      ticks: control steps to be flown at most.
      seed: of the sensors' noise.
      first: number of the first episode, from which its noise is drawn.
      changed: entries of RotorPy's parameters that differ from its Crazyflie.
    """

    def __init__(
        self,
        drones: DroneState,
        tasks: Task,
        ticks: int,
        seed: int,
        first: int = 0,
        changed: dict | None = None,
    ):
        from rotorpy.vehicles.multirotor import Multirotor

        worlds, self.team = drones.position.shape[:2]
        count = worlds * self.team
        self.parameters = crazyflie() | (changed or {})
        self.position = np.asarray(drones.position, float).reshape(count, 3).T.copy()
        self.q = np.asarray(drones.quaternion, float).reshape(count, 4).T.copy()
        self.velocity, self.rates = np.zeros((3, count)), np.zeros((3, count))
        hover = np.sqrt(self.parameters["mass"] * v.GRAVITY / (4 * self.parameters["k_eta"]))
        self.states, self.models = [], []
        for i in range(count):
            state = {
                "x": self.position[:, i].copy(),
                "v": np.zeros(3),
                "q": np.roll(self.q[:, i], -1),
                "w": np.zeros(3),
                "wind": np.zeros(3),
                "rotor_speeds": np.full(4, hover),
            }
            self.states.append(state)
            self.models.append(
                Multirotor(
                    self.parameters,
                    state,
                    control_abstraction="cmd_motor_speeds",
                    aero=True,
                    integrator_kwargs={"method": "RK23", "first_step": SAMPLE, "rtol": 1e-3, "atol": 1e-5},
                )
            )
        drawn = sensors_of(seed, 0)
        self.air = air_of(drawn, seed, 0, ticks + 1, range(first, first + worlds), self.team)
        nominal = v.nominal_parameters([v.Told()] * count)
        self.firmware = Firmware(nominal, self.air["gyro_bias"].astype(float))
        self.solids, self.tick = solids_of(tasks, self.team), 0

    def poses(self) -> Poses:
        """Where the vehicles are."""
        return per_world(self.team, self.position, self.q, self.velocity)

    def measure(self) -> Poses:
        """Poses as they were a few milliseconds ago, with the motion capture's noise."""
        air, k = self.air, self.tick
        late = 1e-3 * air["pose_delay"]
        quaternion = v.multiply(v.turn(self.q, -self.rates, late), air["seen_attitude"][k])
        quaternion /= np.sqrt((quaternion * quaternion).sum(axis=0))
        position = self.position - late * self.velocity + air["seen_position"][k]
        return per_world(self.team, position, quaternion, self.velocity + air["seen_velocity"][k])

    def fly(self, command, max_speed=None) -> None:
        """One tick: five times the rate loop and RotorPy's step, then solid things."""
        command = command.reshape(-1, 4).T
        for part in range(PER_TICK):
            noise = self.air["gyro_bias"] + self.air["gyro"][PER_TICK * self.tick + part]
            motors = self.firmware(command, self.rates + noise)
            speeds = np.sqrt(motors * MOST_THRUST / self.parameters["k_eta"])
            for i, model in enumerate(self.models):
                self.states[i] = model.step(self.states[i], {"cmd_motor_speeds": speeds[:, i]}, SAMPLE)
            self._read()
        self.solids.stop(self.position, self.velocity)
        limit_speed(self.velocity, max_speed)
        for i, state in enumerate(self.states):
            state["x"], state["v"] = self.position[:, i].copy(), self.velocity[:, i].copy()
        self.tick += 1

    def _read(self):
        self.position = np.stack([state["x"] for state in self.states], axis=-1)
        self.velocity = np.stack([state["v"] for state in self.states], axis=-1)
        self.rates = np.stack([state["w"] for state in self.states], axis=-1)
        self.q = np.stack([np.roll(state["q"], 1) for state in self.states], axis=-1)

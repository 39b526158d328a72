"""RotorPy 3 as a world (Folk, Paulos, Kumar 2023; the `dev` extra): its `Multirotor` and its own Crazyflie.

Rigid body, rotors, drag at the hubs and motor lag are RotorPy's, with its identified Crazyflie: 30 g, motors of 72 ms,
other thrust and torque constants. The firmware's rate loop at 500 Hz and the sensors' noise are those of the withheld
plant, since RotorPy's Crazyflie has no motor commands; commanded thrust is in units of the nominal vehicle's.
"""

import numpy as np

from experiments.withheld import body as b
from experiments.withheld import sensors
from experiments.withheld.cases import case_rng
from experiments.worlds.plant import solids_of
from experiments.worlds.world import Poses, per_world
from openjax.pursuit import Task
from openjax.vehicle import DroneState

DT = 0.002  # s, of the rate loop


def crazyflie() -> dict:
    """RotorPy's Crazyflie, with its rotors numbered and turning as the firmware has them."""
    from rotorpy.vehicles.crazyflie_params import quad_params

    hubs = {f"r{i + 1}": np.array([b.ROTOR_X[i], b.ROTOR_Y[i], 0.0]) for i in range(4)}
    return quad_params | {"rotor_pos": hubs, "rotor_directions": b.SPIN}


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
        hover = np.sqrt(self.parameters["mass"] * b.GRAVITY / (4 * self.parameters["k_eta"]))
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
                    integrator_kwargs={"method": "RK23", "first_step": DT, "rtol": 1e-3, "atol": 1e-5},
                )
            )
        shared = sensors.draw_case(case_rng(seed, 0, 1))
        noises = []
        for world in range(worlds):
            rng = case_rng(seed, 0, 3, first + world)
            noises += [sensors.draw_flight(rng, shared, ticks, shared["voltage"]) for _ in range(self.team)]
        self.noise = sensors.stack(noises)
        self.integral, self.previous = np.zeros((3, count)), np.zeros((3, count))
        self.solids, self.tick = solids_of(tasks, self.team), 0

    def poses(self) -> Poses:
        """Where the vehicles are."""
        return per_world(self.team, self.position, self.q, self.velocity)

    def measure(self) -> Poses:
        """Poses as they were a few milliseconds ago, with the motion capture's noise."""
        noise, k = self.noise, min(self.tick, len(self.noise["position"]) - 1)
        late = 1e-3 * (noise["mocap_delay"] + noise["mocap_jitter"][k])
        quaternion = b.multiply(b.turn(self.q, -self.rates, late), noise["attitude"][k])
        quaternion /= np.sqrt((quaternion * quaternion).sum(axis=0))
        position = self.position - late * self.velocity + noise["position"][k]
        return per_world(self.team, position, quaternion, self.velocity + noise["velocity"][k])

    def fly(self, command, max_speed=None) -> None:
        """One tick: five times the rate loop and RotorPy's step, then solid things."""
        command = command.reshape(-1, 4).T
        for sub in range(5):
            loop = min(5 * self.tick + sub, len(self.noise["gyro_loop"]) - 1)
            gyro = self.rates + self.noise["gyro_bias"] + self.noise["gyro_loop"][loop]
            error = np.rad2deg(command[1:] - gyro)
            limit = b.INTEGRAL_LIMIT[:, None]
            self.integral = np.clip(self.integral + DT * error, -limit, limit)
            slope = -np.rad2deg(gyro - self.previous) / DT
            self.previous = gyro
            gains = (gain[:, None] for gain in (b.RATE_KP, b.RATE_KI, b.RATE_KD))
            parts = zip(gains, (error, self.integral, slope), strict=True)
            motors = b.mix(command[0], sum(gain * part for gain, part in parts))
            speeds = np.sqrt(motors * b.MAX_THRUST / self.parameters["k_eta"])
            for i, model in enumerate(self.models):
                self.states[i] = model.step(self.states[i], {"cmd_motor_speeds": speeds[:, i]}, DT)
            self._read()
        self.solids.stop(self.position, self.velocity)
        if max_speed is not None:
            speed = np.sqrt((self.velocity * self.velocity).sum(axis=0)) + 1e-12
            self.velocity *= np.minimum(1.0, max_speed / speed)
        for i, state in enumerate(self.states):
            state["x"], state["v"] = self.position[:, i].copy(), self.velocity[:, i].copy()
        self.tick += 1

    def _read(self):
        self.position = np.stack([state["x"] for state in self.states], axis=-1)
        self.velocity = np.stack([state["v"] for state in self.states], axis=-1)
        self.rates = np.stack([state["w"] for state in self.states], axis=-1)
        self.q = np.stack([np.roll(state["q"], 1) for state in self.states], axis=-1)

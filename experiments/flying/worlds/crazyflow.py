"""crazyflow's brushless Crazyflie as a world (Schuck and others 2026, arXiv
2606.01478), and a policy's flights in it as a case.

    SCIPY_ARRAY_API=1 python -m experiments.flying.worlds.crazyflow OUT [--policy flight] [--layouts
    random passage hidden]

Body, rotors, thrust curve and drag are crazyflow's, with its identified `cf21B_500`;
all else is as in `experiments.flying.worlds.rotorpy`, with the gains of `brushless`.
`openjax diagnose OUT` then says in what crazyflow differs from that vehicle. It is in
no extra: `pip install crazyflow` (0.4).
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from experiments.flying.worlds.game import play
from experiments.flying.worlds.rotorpy import Bodies, RotorPyWorld
from experiments.flying.worlds.study import SEED, loaded_policy
from openjax.flights.csv_table import write_csv
from openjax.flights.manoeuvres import PERIOD
from openjax.flights.reading import CHANNEL_COLUMNS
from openjax.flights.samples import log_of
from openjax.pursuit import SCENARIOS, scenario_task
from openjax.vehicle import load_vehicle, max_rotor_thrust

VEHICLE = "cf21B_500"
VEHICLE_TOML = """\
[vehicle]
airframe = "brushless"
mass_weighed = true

[log]
source = "crazyflow 0.4, cf21B_500"
motion_capture_rate = 100
motor_rows = "sample"
"""


class CrazyflowBodies(Bodies):
    """Bodies whose equations are crazyflow's, with rotor speeds in revolutions a
    minute.
    """

    def step(self, speeds, time):
        """As of `Bodies`; a rotor's speed has no bounds of its own."""
        s = self.state
        half = s + 0.5 * time * self._slope(s, speeds)
        self.state = s + time * self._slope(half, speeds)
        self.state[6:10] /= np.linalg.norm(self.state[6:10], axis=0)

    def _slope(self, s, speeds):
        x, velocity, q, rates, rotor = (part.T for part in np.split(s, (3, 6, 10, 13)))
        x, q, velocity, rates, rotor = self.model(x, q, velocity, rates, speeds.T, rotor_vel=rotor)
        return np.concatenate([part.T for part in (x, velocity, q, rates, rotor)])


class CrazyflowWorld(RotorPyWorld):
    """Vehicles of crazyflow; `rows` are what was sampled at each tick: arrays (B, ...)
    by channel of the log.
    """

    def make_bodies(self, start, firmware):
        """See `RotorPyWorld`."""
        from crazyflow.dynamics import load_params, parametrize
        from crazyflow.dynamics.first_principles import dynamics

        vehicle = load_vehicle("brushless")
        self.rows = []
        for name in ("kp", "ki", "kd"):
            firmware[name][:] = np.asarray(getattr(vehicle, f"rate_{name}"))[:, None]
        self._most = float(max_rotor_thrust(vehicle))
        self._curve = load_params("first_principles", VEHICLE)["rpm2thrust"]
        hover = float(vehicle.mass * vehicle.gravity) / (4 * self._most)
        rotors = self.speeds(np.full((4, start["x"].shape[1]), hover))
        return CrazyflowBodies(parametrize(dynamics, VEHICLE), start | {"rotor_speeds": rotors})

    def speeds(self, motors):
        """See `RotorPyWorld`."""
        from crazyflow.control.transform import motor_force2rotor_vel

        return motor_force2rotor_vel(motors * self._most, self._curve)

    def measure(self):
        """See `RotorPyWorld`."""
        self._seen = super().measure()
        return self._seen

    def fly(self, command):
        """See `RotorPyWorld`."""
        row = {name: value.reshape(-1, value.shape[-1]) for name, value in self._seen.items()}
        row["body_rates"] = (
            self.bodies.rates + self.air["gyro_bias"] + self.air["gyro"][5 * self.tick]
        ).T
        super().fly(command)
        thrust, rates = np.split(command.reshape(-1, 4), (1,), axis=1)
        sensors_told = {
            "command_thrust": thrust,
            "command_body_rates": rates,
            "motor_command": self.motors.T,
        }
        self.rows.append(row | sensors_told)


def main() -> None:
    """Fly a game in each layout, from drawn starts, and write the case."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("out", type=Path, help="folder of the case")
    parser.add_argument("--policy", default="flight")
    parser.add_argument("--layouts", nargs="+", default=["random", "passage", "hidden"])
    options = parser.parse_args()
    worlds = []
    policy, game = loaded_policy(options.policy)
    tasks = [scenario_task(game, SCENARIOS[name]) for name in options.layouts]
    keys = jax.random.split(jax.random.key(SEED), len(tasks))
    tasks = jax.tree.map(lambda *leaves: np.stack(leaves), *tasks)

    def make_world(*of):
        worlds.append(CrazyflowWorld(*of, game.episode_length, SEED))
        return worlds[0]

    statistics = play(policy, game, tasks, keys, make_world)
    rows = {n: np.stack([row[n] for row in worlds[0].rows], 1) for n in worlds[0].rows[0]}
    options.out.mkdir(parents=True)
    for i, layout in enumerate(options.layouts):
        vehicles = []
        for j in range(worlds[0].team * i, worlds[0].team * (i + 1)):
            columns = {
                c: x[j, :, k] for n, x in rows.items() for k, c in enumerate(CHANNEL_COLUMNS[n])
            }
            vehicles.append({"t": PERIOD * np.arange(game.episode_length)} | columns)
        write_csv(options.out / f"{layout}.csv.gz", log_of(vehicles, layout), {"t": 4})
        print(
            layout,
            {n: float(getattr(statistics, n)[i]) for n in ("captured", "capture_step", "crashed")},
        )
    (options.out / "vehicle.toml").write_text(VEHICLE_TOML, encoding="utf-8")


if __name__ == "__main__":
    main()

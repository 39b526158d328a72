"""What other gains of the velocity controller would change: `python -m experiments.velocity_gains`.

A pursuer of the honest game far from everything is told to hover, to fly at full speed, to turn round, and to turn by 90
degrees, for all combinations of gains. Writes experiments/results/velocity_gains.json and .md.
"""

import argparse
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.pages import page_parser, publish, table, where
from openjax.baselines.surroundings import Craft
from openjax.baselines.velocity_controller import Gains, velocity_action
from openjax.commands.command_line import run_command
from openjax.pursuit import Pursuit, PursuitSettings, Task

VELOCITY, ATTITUDE, TILT = (6.0, 8.0, 10.0, 12.0, 15.0), (15.0, 20.0, 25.0, 30.0), (0.7, 1.0, 1.2)
ROUND, ASIDE, END = 130, 190, 260
"""Control steps at which the commanded velocity is turned round and aside, and of the flight; it starts at 60."""
REACHED = 0.8
"""m/s, of 0.98"""


def flown(gains: list[tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and position (G, T, 3) of a vehicle with each of the gains."""
    game = Pursuit(
        PursuitSettings(
            physics="rigid", speed_limit="none", num_pursuers=1, arena_radius=10.0, arena_height=10.0
        )
    )
    task = Task(
        pursuer_position=jnp.array([[-1.0, 0.0, 5.0]]),
        evader_position=jnp.array([-5.0, 0.5, 5.0]),
        pillar_position=jnp.full((5, 2), 9.0),
        pillar_active=jnp.zeros(5, bool),
    )
    craft = Craft.of(game)
    desired = np.zeros((END, 3), np.float32)
    desired[60:ROUND, 0], desired[ROUND:ASIDE, 0], desired[ASIDE:, 1] = craft.speed, -craft.speed, craft.speed

    @jax.jit
    @jax.vmap
    def fly(each):
        def one(carry, wanted):
            observation, state = carry
            action = velocity_action(craft, observation, wanted[None], Gains(*each))
            observation, state, *_ = game.step(jax.random.key(0), state, action)
            return (observation, state), (state.drones.velocity[0], state.drones.position[0])

        return jax.lax.scan(one, game.reset_to(jax.random.key(1), task), desired)[1]

    columns = tuple(jnp.array(column, jnp.float32) for column in zip(*gains, strict=True))
    return jax.tree.map(np.asarray, fly(columns))


def study(options: argparse.Namespace) -> dict:
    """All combinations."""
    gains = list(itertools.product(VELOCITY, ATTITUDE, TILT))
    rows = []
    for each, velocity, position in zip(gains, *flown(gains), strict=True):
        rows.append(
            {
                "gains": each,
                "turned": int(np.argmax(velocity[ROUND:, 0] < -REACHED)) / 100,
                "beyond": float(position[ROUND:ASIDE, 0].max() - position[ROUND, 0]),
                "drift": float(position[ASIDE, 0] - position[ASIDE:, 0].min()),
                "fastest": float(np.linalg.norm(velocity, axis=-1).max()),
                "height": float(np.ptp(position[40:, 2])),
            }
        )
    return {
        "rows": rows,
    }


def report(results: dict) -> list[str]:
    """The page."""
    rows, own = results["rows"], Gains()
    ours = next(row for row in rows if tuple(row["gains"]) == (own.velocity, own.attitude, own.tilt))
    kept = [row for row in rows if row["fastest"] < 1.01]
    chosen = {
        "ours": ours,
        "shortest way to stop": min(rows, key=lambda row: row["beyond"]),
        "the same below 1.01 m/s": min(kept, key=lambda row: row["beyond"]),
        "soonest turned below 1.01 m/s": min(kept, key=lambda row: row["turned"]),
        "longest way to stop": max(rows, key=lambda row: row["beyond"]),
    }
    return [
        "# Gains of the velocity controller",
        "",
        f"{where(results)} {len(rows)} combinations; nominal vehicle, no clamp. From {Craft.speed} m/s "
        "the commanded velocity is turned round, later by 90 degrees.",
        "",
        *table(
            [
                "",
                "velocity, attitude (1/s), tan tilt",
                "turned after (s)",
                "way beyond (m)",
                "sideways drift (m)",
                "fastest (m/s)",
                "height (m)",
            ],
            [
                [
                    name,
                    "{:g}, {:g}, {:g}".format(*row["gains"]),
                    *(f"{row[key]:.{digits}f}" for key, digits in DIGITS.items()),
                ]
                for name, row in chosen.items()
            ],
        ),
    ]


DIGITS = {"turned": 2, "beyond": 3, "drift": 3, "fastest": 2, "height": 3}


def main(arguments: list[str]) -> int:
    """Measure or read it, write both files, print the page."""
    parser = page_parser(__doc__, "velocity_gains")
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)

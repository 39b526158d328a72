"""When do pursuers crash, and would diving longer have saved them? `python -m experiments.starts [--policy NAME ...]`.

Flies policies on vehicles and tasks of `experiments.vehicles` and tells in which share of the episodes a first crash comes
within .3 s of the start, and later. Then again with the thrust held at zero for the first moments, for those pursuers whose
policy begins by cutting it: a start tilted towards something near is saved by turning upright before thrust pushes into
it. No clamp, rate loop at 500 Hz, solid contacts. Writes experiments/results/starts.json and .md (`--out`: others).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.hard_tasks import close, drawn
from experiments.pages import page_parser, publish, table, where
from experiments.vehicles import WHOLE, vehicles, widened
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots
from openjax.commands.validation import uniform_tasks
from openjax.pursuit import Pursuit, RewardSettings
from openjax.store.policies import load_policy
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import FLIGHT_FAMILY

KINDS = ("nominal", "table", WHOLE)
HELD = (3, 5, 7, 9, 11, 13)
"""Control steps (10 ms) for which the thrust is held at zero."""
EARLY = 30
"""Control steps within which a crash counts as one of the start."""
CUT = -0.5
"""First thrust command (-1 to 1) below which a pursuer counts as cutting it."""


def program(settings, policy):
    """The compiled flights: (parameters, tasks, key, bounds (R, 4), held (H,)) -> (H, B) step of the first crash, or 0."""
    vehicle = load_vehicle()

    def run(parameters, tasks, key, bounds, held):
        environment = Pursuit(settings, vehicle, vehicle_bounds=bounds)
        # as `make_evaluate` draws the starts; the same for each time of holding
        keys = jax.random.split(jax.random.split(key)[0], tasks.evader_position.shape[0])
        shape = held.shape[0], keys.shape[0]
        number = shape[0] * shape[1]
        worlds = jax.tree.map(lambda x: jnp.tile(x, (shape[0],) + (1,) * (x.ndim - 1)), (keys, tasks))
        held = jnp.repeat(held, shape[1])[:, None]
        observation, state = jax.vmap(environment.reset_to)(*worlds)
        step = jax.vmap(environment.step, in_axes=(None, 0, 0))

        def one(carry, i):
            observation, state, cuts, crash = carry
            predicted = policy.predict(parameters, observation)
            mean, _ = policy.distribution(parameters.actor, observation, predicted)
            action = policy.action(mean, observation)
            cuts = jnp.where(i == 0, action[..., 0] < CUT, cuts)
            thrust = jnp.where((i < held) & cuts, -1.0, action[..., 0])
            observation, state, *_, info = step(key, state, action.at[..., 0].set(thrust))
            now = jnp.any(info.crashed, axis=-1) & (crash == 0)
            return (observation, state, cuts, jnp.where(now, i + 1, crash)), None

        start = (
            observation,
            state,
            jnp.zeros((number, settings.num_pursuers), bool),
            jnp.zeros(number, jnp.int32),
        )
        return jax.lax.scan(one, start, jnp.arange(settings.episode_length))[0][3].reshape(shape)

    return jax.jit(run)


def fly(name: str, number: int) -> dict[str, dict[str, dict]]:
    """Shares of crashed episodes by vehicle and kind of task."""
    loaded = load_policy(name)
    drawn_from = loaded.settings.environment
    game = dataclasses.replace(
        drawn_from,
        speed_limit="none",
        substeps=5,
        physics="rigid",
        vehicles=FLIGHT_FAMILY,
        rare_vehicles=0.5,
        max_pillars=layout_slots(drawn_from),
        reward=RewardSettings(),
    )
    tasks = {
        "uniform": uniform_tasks(drawn_from, number, game.max_pillars),
        "close": widened(drawn(drawn_from, close, number), game.max_pillars),
    }
    run = program(game, loaded.policy)
    found: dict[str, dict[str, dict]] = {}
    for kind in KINDS:
        for task_kind, chosen in tasks.items():
            first = np.asarray(
                run(loaded.parameters, chosen, jax.random.key(0), vehicles()[kind], jnp.array((0, *HELD)))
            )
            own = first[0]
            found.setdefault(kind, {})[task_kind] = {
                "early": float(((own > 0) & (own <= EARLY)).mean()),
                "later": float((own > EARLY).mean()),
                "held": {
                    str(held): float((then > 0).mean()) for held, then in zip(HELD, first[1:], strict=True)
                },
            }
            print(name, kind, task_kind, found[kind][task_kind], flush=True)
    return found


def study(options) -> dict:
    """Fly the policies."""
    return {
        "number": options.number,
        "policies": {name: fly(name, options.number) for name in options.policy},
    }


def report(results: dict) -> list[str]:
    """The page."""
    rows = [
        [
            name,
            kind,
            task_kind,
            f"{found['early']:.4f}",
            f"{found['later']:.4f}",
            *(f"{found['held'][str(held)]:.4f}" for held in HELD),
        ]
        for name, kinds in results["policies"].items()
        for kind, tasks in kinds.items()
        for task_kind, found in tasks.items()
    ]
    return [
        "# When pursuers crash",
        "",
        f"{where(results)} {results['seconds']:.0f} s. {results['number']} validation tasks of each kind, vehicles as in "
        f"[vehicles.md](vehicles.md). Share of the episodes whose first crash comes within {EARLY / 100:.1f} s of the start, and "
        "later; then of all that crash if the thrust of those who begin by cutting it is held at zero for the first moments.",
        "",
        *table(
            ["policy", "vehicle", "tasks", "early", "later", *(f"held {held / 100:.2f} s" for held in HELD)],
            rows,
        ),
    ]


def main(arguments: list[str]) -> int:
    """Fly, write both files."""
    parser = page_parser(__doc__, "starts")
    parser.add_argument(
        "--policy", nargs="+", default=["flight", "no_clamp_seed_0"], help="names, runs or policy files"
    )
    parser.add_argument("--number", type=int, default=1024, help="tasks of each kind")
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)

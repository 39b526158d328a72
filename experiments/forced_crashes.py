"""How many starts can nobody fly? `python -m experiments.forced_crashes [--policy NAME ...] [--number 1024] [--layouts 100]`.

Starts are drawn tilted by up to 36 degrees, some beside a pillar or another pursuer: some crashes no controller avoids. Of
each kind of tasks and vehicle the page tells the share of episodes in which each policy crashes, in which all of them do,
and in which neither any policy nor a search avoids the crash. The search knows the vehicle, sees without delay and plans
wanted accelerations of all pursuers for the first steps (cross-entropy method); a plan counts if nothing is touched and all
end slow and upright. What it doesn't find may exist: the last share is an upper bound of what is forced. No clamp, rate
loop at 500 Hz, solid contacts. Writes experiments/results/forced_crashes.json and .md (`--out`: others).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.hard_tasks import close, drawn
from experiments.pages import page_parser, publish, table, where
from experiments.vehicles import NAMES, WHOLE, program, vehicles, widened
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots, repeat_task
from openjax.commands.validation import uniform_tasks
from openjax.learning import preset
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings, scenario_task
from openjax.pursuit.collisions import crashed, drone_distance, pillar_distance
from openjax.pursuit.observation import rotation_axes
from openjax.store.policies import load_policy
from openjax.vehicle import load_vehicle
from openjax.vehicle.solids import DRONE_RADIUS

KINDS = ("nominal", "table", WHOLE)
ATTITUDE_GAIN = 12.0
"""Body rate per angle to the wanted thrust direction (1/s)."""
MARGIN = 0.03
"""Gaps (m) below which a plan costs something."""
SLOW, UPRIGHT = 0.8, 0.7
"""Speed (m/s) and cosine of the tilt with which a saved pursuer ends at most."""


class Search(NamedTuple):
    """Sizes of the cross-entropy method."""

    samples: int = 256
    elites: int = 32
    rounds: int = 24
    knots: int = 8
    hold: int = 8
    """Control steps for which a wanted acceleration is held."""


def levelling(vehicle, drones, wanted):
    """Commands (N, 4) towards (N, 3) wanted accelerations in units of gravity: thrust, and body rates that turn it there."""
    hover = vehicle.mass * vehicle.gravity / (4 * vehicle.thrust_constant * vehicle.max_rotor_speed**2)
    force = wanted.at[:, 2].add(1.0)
    body_x, body_z = rotation_axes(drones.quaternion)
    body_y = jnp.cross(body_z, body_x)
    size = jnp.maximum(jnp.linalg.norm(force, axis=-1, keepdims=True), 0.05)
    along_x, along_y = (jnp.sum(force / size * axis, axis=-1) for axis in (body_x, body_y))
    rates = ATTITUDE_GAIN * jnp.stack([-along_y, along_x, jnp.zeros_like(along_x)], axis=-1)
    thrust = jnp.clip(hover * jnp.sum(force * body_z, axis=-1), 0.0, 0.9)
    return jnp.concatenate([thrust[:, None], jnp.clip(rates, -jnp.pi, jnp.pi)], axis=-1)


def outcome(environment: Pursuit, state, plan: jax.Array, hold: int):
    """Cost () of a plan (K, N, 3) from a state, and whether it fails ()."""
    settings, pillars = environment.settings, (state.task.pillar_position, state.task.pillar_active)
    parameters = {**state.vehicles, **environment.effect_parameters}

    def one(carry, i):
        drones, worst, touched = carry
        command = levelling(environment.vehicle, drones, plan[i // hold])
        drones = environment.dynamics(environment.vehicle, drones, command, *pillars, parameters)
        up = rotation_axes(drones.quaternion)[1][:, 2]
        touched |= jnp.any(crashed(settings, drones.position, up, *pillars))
        to_pillar = jnp.where(
            pillars[1][None], pillar_distance(settings, drones.position, pillars[0]), jnp.inf
        )
        gap = jnp.minimum(jnp.min(to_pillar, axis=-1), drones.position[:, 2]) - DRONE_RADIUS
        gap = jnp.minimum(gap, jnp.min(drone_distance(drones.position), axis=-1) - 2 * DRONE_RADIUS)
        lacking = jnp.sum(jnp.maximum(MARGIN - gap, 0.0)) + 0.05 * jnp.sum(jnp.maximum(0.5 - up, 0.0))
        return (drones, jnp.maximum(worst, lacking), touched), None

    start = state.drones, jnp.zeros(()), jnp.zeros((), bool)
    (drones, worst, touched), _ = jax.lax.scan(one, start, jnp.arange(plan.shape[0] * hold))
    speed = jnp.max(jnp.linalg.norm(drones.velocity, axis=-1))
    up = jnp.min(rotation_axes(drones.quaternion)[1][:, 2])
    failed = touched | (speed > SLOW) | (up < UPRIGHT)
    ending = jnp.maximum(speed - SLOW / 2, 0.0) + jnp.maximum(UPRIGHT + 0.1 - up, 0.0)
    return worst + touched + 0.05 * ending, failed


def found(environment: Pursuit, state, key: jax.Array, sizes: Search) -> jax.Array:
    """() whether a plan was found that saves all pursuers of a state."""
    shape = sizes.knots, environment.settings.num_pursuers, 3

    def one_round(carry, key):
        mean, deviation, saved = carry
        plans = mean + deviation * jax.random.normal(key, (sizes.samples, *shape))
        plans = plans.at[0].set(mean)
        costs, failed = jax.vmap(lambda plan: outcome(environment, state, plan, sizes.hold))(plans)
        best = plans[jnp.argsort(costs)[: sizes.elites]]
        mean = 0.2 * mean + 0.8 * jnp.mean(best, axis=0)
        deviation = jnp.maximum(0.25 * deviation + 0.75 * jnp.std(best, axis=0), 0.03)
        return (mean, deviation, saved | ~jnp.all(failed)), None

    start = jnp.zeros(shape), jnp.broadcast_to(jnp.array([0.5, 0.5, 0.4]), shape), jnp.zeros((), bool)
    return jax.lax.scan(one_round, start, jax.random.split(key, sizes.rounds))[0][2]


def game(settings: PursuitSettings) -> PursuitSettings:
    """The game in which crashes are counted; policies of other histories start alike."""
    base = preset("flight").environment
    return dataclasses.replace(
        settings,
        speed_limit="none",
        substeps=base.substeps,
        physics="rigid",
        vehicles=base.vehicles,
        rare_vehicles=base.rare_vehicles,
        max_pillars=layout_slots(settings),
        reward=RewardSettings(),
    )


def one_vehicle(values: dict[str, str]) -> np.ndarray:
    """Bounds (R, 4) of the vehicle that has these parameters beside the nominal ones."""
    bounds = vehicles()["nominal"].copy()
    for name, value in values.items():
        bounds[NAMES.index(name)] = float(value)
    return bounds


def all_tasks(settings: PursuitSettings, number: int, layouts: int):
    """Tasks by kind, with as many pillar slots as the layouts need."""
    slots = layout_slots(settings)
    tasks = {
        "uniform": uniform_tasks(settings, number, slots),
        "close": widened(drawn(settings, close, number), slots),
    }
    if layouts:
        for name, scenario in SCENARIOS.items():
            tasks[name] = repeat_task(scenario_task(game(settings), scenario), layouts)
    return tasks


def searched(settings: PursuitSettings, chosen: np.ndarray, tasks, keys, bounds, options) -> np.ndarray:
    """Which of the `chosen` tasks (indices) the search saves."""
    sizes = Search(samples=options.samples, rounds=options.rounds)

    @jax.jit
    def run(tasks, keys, bounds):
        environment = Pursuit(settings, load_vehicle(), vehicle_bounds=bounds)
        _, states = jax.vmap(environment.reset_to)(keys, tasks)
        own = jax.random.split(jax.random.key(1), keys.shape[0])
        return jax.vmap(lambda state, key: found(environment, state, key, sizes))(states, own)

    saved = []
    for first in range(0, len(chosen), options.chunk):
        some = chosen[first : first + options.chunk]
        padded = np.resize(some, options.chunk)  # one compilation
        part = jax.tree.map(lambda leaf, padded=padded: leaf[padded], tasks)
        saved.append(np.asarray(run(part, keys[padded], bounds))[: len(some)])
    return np.concatenate(saved) if saved else np.zeros(0, bool)


def study(options) -> dict:
    """Fly the policies, then search where all of them crash."""
    policies = {name: load_policy(name) for name in options.policy}
    drawn_from = preset("flight").environment
    tasks = all_tasks(drawn_from, options.number, options.layouts)
    sizes = [leaf.shape[0] for leaf in (kind.evader_position for kind in tasks.values())]
    together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *tasks.values())
    ends = np.cumsum(sizes)
    key = jax.random.key(0)
    keys = jax.random.split(jax.random.split(key)[0], int(ends[-1]))  # as `make_evaluate` draws the starts
    figures: dict[str, dict[str, dict]] = {}
    kinds = {name: vehicles()[name] for name in options.vehicles}
    if options.own:
        kinds[" ".join(options.own)] = one_vehicle(dict(word.split("=") for word in options.own))
    for vehicle, bounds in kinds.items():
        crashes = {}
        for name, loaded in policies.items():
            run = program(game(loaded.settings.environment), loaded.policy)
            statistics = run(loaded.parameters, together, key, bounds).statistics
            crashes[name] = np.asarray(statistics.crashed)
        every = np.logical_and.reduce(list(crashes.values()))
        chosen = np.flatnonzero(every)
        bare = dataclasses.replace(game(drawn_from), observe_history=0)
        saved = searched(bare, chosen, together, keys, bounds, options)
        lost = every.copy()
        lost[chosen] = ~saved
        figures[vehicle] = {
            kind: {
                "episodes": size,
                "policies": {name: float(crash[end - size : end].mean()) for name, crash in crashes.items()},
                "all": float(every[end - size : end].mean()),
                "not_saved": float(lost[end - size : end].mean()),
            }
            for kind, size, end in zip(tasks, sizes, ends, strict=True)
        }
        for kind, row in figures[vehicle].items():
            print(vehicle, kind, row, flush=True)
    return {
        "figures": figures,
    }


def report(results: dict) -> list[str]:
    """The page."""
    figures = results["figures"]
    names = list(next(iter(next(iter(figures.values())).values()))["policies"])
    rows = [
        [
            vehicle,
            kind,
            str(row["episodes"]),
            *(f"{row['policies'][name]:.4f}" for name in names),
            f"{row['all']:.4f}",
            f"{row['not_saved']:.4f}",
        ]
        for vehicle, kinds in figures.items()
        for kind, row in kinds.items()
    ]
    return [
        "# Crashes that nobody avoids",
        "",
        f"{where(results)} {results['seconds']:.0f} s. Share of the episodes in which each policy crashes, in which all of "
        "them do, and in which a search that knows the vehicle and sees without delay finds no way out either: an upper "
        "bound of the crashes that the drawn starts force. Vehicles and tasks as in [vehicles.md](vehicles.md).",
        "",
        *table(["vehicle", "tasks", "episodes", *names, "all of them", "no search saves"], rows),
    ]


def main(arguments: list[str]) -> int:
    """Fly, search, write both files."""
    parser = page_parser(__doc__, "forced_crashes")
    parser.add_argument(
        "--policy", nargs="+", default=["flight", "no_clamp_seed_0"], help="names, runs or policy files"
    )
    parser.add_argument("--vehicles", nargs="*", choices=list(vehicles()), default=KINDS)
    parser.add_argument("--own", nargs="*", metavar="PARAMETER=VALUE", help="one more vehicle")
    parser.add_argument("--number", type=int, default=1024, help="tasks of each kind")
    parser.add_argument("--layouts", type=int, default=100, help="episodes of each layout; 0: none")
    parser.add_argument("--samples", type=int, default=Search().samples, help="plans of a round")
    parser.add_argument("--rounds", type=int, default=Search().rounds)
    parser.add_argument("--chunk", type=int, default=256, help="tasks that are searched at once")
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)

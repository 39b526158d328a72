"""Policies on vehicles that they weren't made for: `python -m experiments.flying.vehicles [--policy NAME ...] [--number 1024]`.

No clamp, rate loop at 500 Hz, solid contacts. Vehicles: the nominal one; `table`, with motors 40 ms slower, commands 15 ms
and poses 10 ms late, and drag; the family of the preset `flight`, ordinary and whole; and for each of its effects vehicles
that are out of the ordinary in it alone. Tasks: uniform validation ones, with rows of pillars, with close starts, and at the
end the six layouts, for the first three kinds of vehicles. Nothing is chosen by the layouts. Writes
experiments/results/vehicles.json and .md (`--out`: others).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper.hard_tasks import close, drawn, row
from experiments.table import Page, Table, cell, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots, repeat_task
from openjax.commands.validation import uniform_tasks
from openjax.learning import make_evaluate, summarise
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings, scenario_task
from openjax.store.policies import load_policy
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import family_bounds, find_parameter, vehicle_family
from openjax.vehicle.parameters import AIRFRAMES, NOMINAL

TABLE = {
    "motor_lag.extra_up": 0.04, "motor_lag.extra_down": 0.04, "command_latency.delay": 0.015, "state_latency.delay": 0.01,
    "rotor_drag.d_xy": 0.0125, "rotor_drag.d_z": 0.0125,
}  # fmt: skip
EFFECTS = sorted({entry.parameter.partition(".")[0] for entry in vehicle_family()})
WHOLE = "family"
FIGURES = {
    "capture": "capture_rate:.3f", "step": "capture_step:.0f", "collision": "collision_rate:.4f",
    "crash": "crash_rate:.4f", "over speed": "over_speed_rate:.4f",
}  # fmt: skip


def vehicles(airframe: str = NOMINAL) -> dict[str, np.ndarray]:
    """Bounds (R, 4) of each kind of an airframe's vehicles; only the whole family has any that are rare."""
    family = vehicle_family(airframe)
    bounds, names = family_bounds(family), [entry.parameter for entry in family]
    none = np.repeat([[find_parameter(name)[1].none] for name in names], 4, axis=1).astype(np.float32)
    one = none.copy()
    for name, value in TABLE.items():
        one[names.index(name)] = value
    ordinary = np.tile(bounds[:, :2], 2)
    kinds = {"nominal": none, "table": one, "ordinary": ordinary, WHOLE: bounds}
    for effect in EFFECTS:
        own = np.array([name.partition(".")[0] == effect for name in names])
        kinds[effect] = np.where(own[:, None], np.tile(bounds[:, 2:], 2), ordinary)
    return kinds


@functools.cache
def program(settings, policy):
    """The compiled evaluation: (parameters, tasks, key, bounds (R, 4)) -> Evaluation."""
    vehicle = load_vehicle(settings.airframe)

    def run(parameters, tasks, key, bounds):
        environment = Pursuit(settings, vehicle, vehicle_bounds=bounds)
        return make_evaluate(environment, policy)(parameters, tasks, key)

    return jax.jit(run)


def fly(name: str, options) -> dict[str, dict[str, dict]]:
    """Summaries of a policy by kind of vehicle and kind of task. `options`: of the command."""
    number, layouts = options.number, options.layouts
    loaded = load_policy(name)
    airframe = options.airframe or loaded.settings.environment.airframe
    game = dataclasses.replace(
        loaded.settings.environment,
        airframe=airframe,
        speed_limit="none",
        substeps=5,
        physics=options.physics,
        start_attitude=options.attitude,
        vehicles=vehicle_family(airframe),
        rare_vehicles=0.5,
        max_pillars=layout_slots(loaded.settings.environment),
        reward=RewardSettings(),  # counts for nothing here: the same program for policies that differ in it
    )
    # the same tasks for policies that were trained with fewer pillars
    paper = PursuitSettings()
    drawn_from = dataclasses.replace(
        loaded.settings.environment, min_pillars=paper.min_pillars, max_pillars=paper.max_pillars
    )
    slots = game.max_pillars
    tasks = {
        "uniform": uniform_tasks(drawn_from, number, slots),
        "row": widened(drawn(drawn_from, row, number), slots),
        "close": widened(drawn(drawn_from, close, number), slots),
    }
    repeated = [repeat_task(scenario_task(game, SCENARIOS[layout]), layouts) for layout in SCENARIOS]
    flat = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *repeated)
    found: dict[str, dict[str, dict]] = {}
    run = program(game, loaded.policy)
    for kind, bounds in vehicles(airframe).items():
        if options.vehicles and kind not in options.vehicles:
            continue
        shown = tasks if kind in ("nominal", "table", "ordinary", WHOLE) else {"uniform": tasks["uniform"]}
        own = found.setdefault(kind, {})
        for task_kind, drawn_tasks in shown.items():
            own[task_kind] = finite(summarise(run(loaded.parameters, drawn_tasks, jax.random.key(0), bounds)))
        if layouts and kind in ("nominal", "table", WHOLE):
            together = run(loaded.parameters, flat, jax.random.key(1), bounds)
            for i, layout in enumerate(SCENARIOS):
                part = slice(i * layouts, (i + 1) * layouts)
                own[layout] = finite(summarise(jax.tree.map(lambda leaf, part=part: leaf[part], together)))
        for task_kind, summary in own.items():
            print(name, kind, task_kind, *(cell(summary, column) for column in FIGURES.values()), flush=True)
    return found


def finite(summary: dict) -> dict:
    """`summary` without what isn't a number."""
    return {name: value for name, value in summary.items() if isinstance(value, dict) or np.isfinite(value)}


def widened(tasks, slots: int):
    """`tasks` with more pillar slots, unused."""
    extra = slots - tasks.pillar_active.shape[-1]
    return tasks.replace(
        pillar_position=jnp.pad(tasks.pillar_position, ((0, 0), (0, extra), (0, 0))),
        pillar_active=jnp.pad(tasks.pillar_active, ((0, 0), (0, extra))),
    )


def study(options) -> dict:
    """Fly the policies."""
    policies = {name: fly(name, options) for name in options.policy}
    drawn_by = {name: getattr(options, name) for name in ("number", "layouts", "attitude", "airframe")}
    return {**drawn_by, "policies": policies}


def page(results: dict) -> Page:
    """A row per policy, kind of vehicle and kind of task."""
    rows = [
        {"policy": name, "vehicle": kind, "tasks": tasks, **summary}
        for name, kinds in results["policies"].items()
        for kind, found in kinds.items()
        for tasks, summary in found.items()
    ]
    return Page(
        "Policies on other vehicles",
        f"No clamp, rate loop at 500 Hz, {results.get('attitude', 'drawn')} starts; {results['number']} validation tasks of each "
        f"kind, {results['layouts']} episodes of each layout. Nominal: the nominal vehicle; table: motors 40 ms slower, "
        "commands 15 ms and poses 10 ms late, drag of .0125 N s/m; ordinary and family: the vehicles of the preset flight "
        "without and with the rare ones; a name: all vehicles out of the ordinary in that effect. "
        + results.get("note", ""),
        Table({"policy": "policy", "vehicle": "vehicle", "tasks": "tasks", **FIGURES}, rows),
    )


def main(arguments: list[str]) -> int:
    """Evaluate and write both files."""
    parser = page_parser(__doc__, "vehicles")
    parser.add_argument("--policy", nargs="+", default=["open", "flight"], help="names, runs or policy files")
    parser.add_argument("--number", type=int, default=1024, help="tasks of each kind")
    parser.add_argument("--layouts", type=int, default=0, help="episodes of each layout; 0: none")
    parser.add_argument("--physics", default="rigid")
    parser.add_argument(
        "--attitude", choices=("drawn", "level"), default="drawn", help="how pursuers are tilted at the start"
    )
    parser.add_argument(
        "--vehicles", nargs="+", choices=list(vehicles()), help="kinds of vehicles; default: all"
    )
    parser.add_argument("--airframe", choices=list(AIRFRAMES), help="what flies; default: the policy's own")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

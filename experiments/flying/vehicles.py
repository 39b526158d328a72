"""Policies on vehicles that they weren't made for: `python -m experiments.flying.vehicles [--policy
NAME ...] [--number 1024]`.

No clamp, rate loop at 500 Hz, solid contacts, drawn starts, the paper's evader. Vehicles: the
nominal one; `table`, with motors 40 ms slower, commands 15 ms and poses 10 ms late, and drag; the
family of the preset `flight`. Tasks: uniform validation ones and the six layouts. Nothing is chosen
by the layouts. Writes experiments/results/vehicles.json and .md (`--out`: others).
"""

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np

from experiments.table import Column, Page, Table, cell, page_parser, publish
from openjax.command_line import run_command
from openjax.evaluation.episodes import make_evaluate, summarise
from openjax.evaluation.evaluator import layout_slots, layout_tasks, stack
from openjax.evaluation.validation import uniform_tasks
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings
from openjax.store.policies import load_policy
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects.effects_file import load_effects
from openjax.vehicle.family import family_bounds, find_parameter, vehicle_family
from openjax.vehicle.parameters import AIRFRAMES, NOMINAL

SLOWER = Path(__file__).with_name("slower.toml")
"""The slower vehicle's effects, for `--effects` of commands."""
TABLE = {
    f"{effect}.{parameter}": value
    for effect, parameters in load_effects(SLOWER)[1].items()
    for parameter, value in parameters.items()
}
FIGURES = {
    "capture": "capture_rate:.3f", "step": "capture_step:.0f", "collision": "collision_rate:.4f",
    "crash": "crash_rate:.4f", "over speed": "over_speed_rate:.4f",
}  # fmt: skip


def vehicles(airframe: str = NOMINAL) -> dict[str, np.ndarray]:
    """Bounds (R, 4) of each kind of an airframe's vehicles; only the family has any that are rare."""
    family = vehicle_family(airframe)
    names = [entry.parameter for entry in family]
    none = np.repeat([[find_parameter(name)[1].none] for name in names], 4, axis=1).astype(
        np.float32
    )
    one = none.copy()
    for name, value in TABLE.items():
        one[names.index(name)] = value
    return {"nominal": none, "table": one, "family": family_bounds(family)}


@functools.cache
def program(settings, policy):
    """The compiled evaluation: (parameters, tasks, key, bounds (R, 4)) -> Evaluation."""
    vehicle = load_vehicle(settings.airframe)

    def run(parameters, tasks, key, bounds):
        environment = Pursuit(settings, vehicle, vehicle_bounds=bounds)
        return make_evaluate(environment, policy)(parameters, tasks, key)

    return jax.jit(run)


def game_of(own: PursuitSettings, airframe: str, physics: str) -> PursuitSettings:
    """The game that a policy is measured in, `own` being that of its training."""
    return dataclasses.replace(
        own,
        airframe=airframe,
        speed_limit="none",
        substeps=5,
        physics=physics,
        start_attitude="drawn",
        evaders=("field",),
        vehicles=vehicle_family(airframe),
        rare_vehicles=0.5,
        min_pillars=PursuitSettings().min_pillars,  # of uniform tasks
        max_pillars=layout_slots(own),
        # counts for nothing here: the same program for policies that differ in it
        reward=RewardSettings(),
    )


def fly(name: str, options) -> dict[str, dict[str, dict]]:
    """Summaries of a policy by kind of vehicle and kind of task. `options`: of the command."""
    policy = load_policy(name)
    game_settings = policy.settings.environment
    game = game_of(game_settings, options.airframe or game_settings.airframe, options.physics)
    drawn_from = dataclasses.replace(game, max_pillars=PursuitSettings().max_pillars)
    kinds = {"uniform": uniform_tasks(drawn_from, options.number, game.max_pillars)}
    if options.layouts:
        kinds |= layout_tasks(game, SCENARIOS.values(), options.layouts)
    (tasks, part), (run, records) = stack(kinds), (program(game, policy.policy), {})
    for kind, bounds in vehicles(game.airframe).items():
        if kind in options.vehicles:
            flown = jax.tree.map(
                np.asarray, run(policy.parameters, tasks, jax.random.key(0), bounds)
            )
            for tasks_of, statistics in part(flown).items():
                summary = summarise(statistics)
                records.setdefault(kind, {})[tasks_of] = finite(summary)
                figures = (cell(summary, column) for column in FIGURES.values())
                print(name, kind, tasks_of, *figures, flush=True)
    return records


def finite(summary: dict) -> dict:
    """`summary` without what isn't a number."""
    return {
        name: value
        for name, value in summary.items()
        if isinstance(value, dict) or np.isfinite(value)
    }


def study(options) -> dict:
    """Fly the policies."""
    drawn_by = {name: getattr(options, name) for name in ("number", "layouts", "airframe")}
    return {**drawn_by, "policies": {name: fly(name, options) for name in options.policy}}


def page(results: dict) -> Page:
    """A row per policy."""
    return Page(
        "Policies on other vehicles",
        f"No clamp, rate loop at 500 Hz, drawn starts, contacts of `rigid`; {results['number']} "
        f"uniform validation tasks, {results['layouts']} episodes of each layout. Nominal: the "
        "nominal vehicle; table: motors 40 ms slower, commands 15 ms and poses 10 ms late, drag of "
        ".0125 N s/m; family: the vehicles of the preset flight, "
        "half of them rare ones. " + results.get("note", ""),
        over_layouts(results),
    )


def over_layouts(results: dict) -> Table:
    """A row per policy: captures and crashes with each kind of vehicle, mean over the layouts."""
    columns: dict[str, Column] = {"policy": "policy"}
    rows = []
    for name, kinds in results["policies"].items():
        row: dict = {"policy": name}
        for kind, records in kinds.items():
            layouts = [summary for tasks, summary in records.items() if tasks in SCENARIOS]
            for word, figure in (("captures", "capture_rate"), ("crashes", "crash_rate")):
                head = f"{kind}: {word}"
                row[head] = float(np.mean([summary[figure] for summary in layouts]))
                columns[head] = lambda r, head=head: f"{r[head]:.3f}"
        rows.append(row)
    return Table(columns, rows)


def main(arguments: list[str]) -> int:
    """Evaluate and write both files."""
    parser = page_parser(__doc__, "vehicles")
    parser.add_argument(
        "--policy", nargs="+", default=["open", "flight"], help="names, runs or policy files"
    )
    parser.add_argument("--number", type=int, default=1024, help="uniform tasks")
    parser.add_argument("--layouts", type=int, default=100, help="episodes of each layout; 0: none")
    parser.add_argument("--physics", default="rigid")
    parser.add_argument("--vehicles", nargs="+", choices=list(vehicles()), default=list(vehicles()))
    parser.add_argument(
        "--airframe", choices=list(AIRFRAMES), help="what flies; default: the policy's own"
    )
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

"""Policies against every evader: `python -m experiments.evaders.cross_play --policy
NAME ... [--game own|honest|clamp]`.

All evaders by name, on the six layouts and on uniform tasks, with the nominal vehicle,
a slower one and the family of the preset `flight`. Nothing is chosen by any of it;
held-out evaders were never trained on. Game "own": the policy's; "honest": no clamp on
the speed, the rate loop at 500 Hz; "clamp": the paper's, at 100 Hz. Writes evaders.json
and .md (`--out`: others).
"""

import dataclasses
import functools
import math
from collections import defaultdict
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from experiments.flying.vehicles import vehicles
from experiments.table import RESULTS, Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.evaluation.episodes import wilson
from openjax.evaluation.evaluator import layout_slots, layout_tasks, stack
from openjax.evaluation.judges.duel import Duel
from openjax.evaluation.judges.scripted import fly_scripted
from openjax.evaluation.judges.tasks import judging_tasks
from openjax.files import read_json
from openjax.pursuit import (
    SCENARIOS,
    EpisodeStatistics,
    Pursuit,
    PursuitSettings,
    RewardSettings,
    Task,
)
from openjax.pursuit.evaders import EVADERS, HELD_OUT, SCRIPTED, VALIDATED
from openjax.store import DEFAULT_POLICY
from openjax.store.policies import LoadedPolicy, load_policy
from openjax.vehicle.family import vehicle_family

GAMES = {
    "own": {},
    "honest": {"speed_limit": "none", "substeps": 5},
    "clamp": {"speed_limit": "clamp", "substeps": 1},
}
"""What of a policy's game changes."""
CASE = ("policy", "game", "vehicle")
COUNTS = ("episodes", "captures", "crash_rate", "capture_step")
"""What is stored of each evader and kind of tasks, in this order."""


@functools.cache
def program(settings: PursuitSettings, policy):
    """Compiled episodes of vehicles within bounds (R, 4); see `fly_scripted`."""

    game = Pursuit(settings)

    def run(vehicle_bounds, *arguments):
        return fly_scripted(Duel(game.with_bounds(vehicle_bounds), policy), *arguments)

    return jax.jit(run)


def game_of(loaded: LoadedPolicy, game: str, physics: str) -> PursuitSettings:
    """The policy's game with all evaders and the family of vehicles; see the module."""
    settings = loaded.settings.environment
    settings = dataclasses.replace(
        settings,
        evaders=SCRIPTED,
        physics=physics,
        vehicles=vehicle_family(),
        rare_vehicles=0.5,
        # of uniform tasks, which have four or five
        min_pillars=4,
        max_pillars=layout_slots(settings),
        # counts for nothing here: the same program for policies that differ in it
        reward=RewardSettings(),
    )
    return dataclasses.replace(settings, **GAMES[game])


def kinds_of(settings: PursuitSettings, layouts: int, uniform: int) -> dict[str, Task]:
    """Each kind of tasks by name."""
    tasks = layout_tasks(settings, SCENARIOS.values(), layouts)
    return {**tasks, "uniform": judging_tasks(settings, uniform)}


def fly(name: str, options) -> list[dict]:
    """A record for each vehicle, evader and kind of task."""
    loaded = load_policy(name)
    settings = game_of(loaded, options.game, options.physics)
    tasks, part = stack(kinds_of(settings, options.episodes, options.uniform))
    run = program(settings, loaded.in_game(Pursuit(settings)).policy)
    records = []
    for vehicle in options.vehicles:
        bounds = jnp.asarray(vehicles()[vehicle])
        for i, evader in enumerate(SCRIPTED):  # one at a time: no other is worked out
            flown = run(bounds, loaded.parameters, tasks, jnp.int32(i), jax.random.key(0))
            for kind, own in part(jax.tree.map(np.asarray, flown)).items():
                case = {"policy": name, "game": options.game, "vehicle": vehicle, "evader": evader}
                records.append({**case, "tasks": kind, **summary(own)})
    return records


def summary(statistics: EpisodeStatistics) -> dict:
    """Counts and means over episodes."""
    number = len(statistics.captured)
    captures = int(statistics.captured.sum())
    return {
        "episodes": number,
        "captures": captures,
        "capture_rate": captures / number,
        "crash_rate": float(statistics.crashed.mean()),
        "capture_step": float(statistics.capture_step.mean()),
    }


def study(options) -> dict:
    """Fly the policies."""
    return {"flights": nested([record for name in options.policy for record in fly(name, options)])}


def nested(records: list[dict]) -> list[dict]:
    """Records as they are stored: for each policy, game and vehicle the `COUNTS` of
    each evader and kind of tasks. One after the other, with all their names, they'd be
    a file of a megabyte.
    """
    flights = {}
    for record in records:
        case = tuple(record[name] for name in CASE)
        if case not in flights:
            flights[case] = {**dict(zip(CASE, case, strict=True)), "counts": COUNTS, "evaders": {}}
        tasks = flights[case]["evaders"].setdefault(record["evader"], {})
        tasks[record["tasks"]] = [round(record[name], 5) for name in COUNTS]
    return list(flights.values())


def records_of(flights: list[dict]) -> list[dict]:
    """The records again, one of each policy, game, vehicle, evader and kind of
    tasks.
    """
    records = []
    for flight in flights:
        case = {name: flight[name] for name in CASE}
        for evader, by_tasks in flight["evaders"].items():
            for tasks, counts in by_tasks.items():
                record = dict(zip(flight["counts"], counts, strict=True))
                rate = record["captures"] / record["episodes"]
                record |= {"evader": evader, "tasks": tasks, "capture_rate": rate}
                records.append(case | record)
    return records


def page(results: dict) -> Page:
    """First what matters of each policy and vehicle, then capture rates and crashes by
    evader, then how it was learnt.
    """
    by_policy = defaultdict(list)
    for record in records_of(results["flights"]):
        by_policy[tuple(record[name] for name in CASE)].append(record)
    columns = {
        **{name: name for name in CASE},
        "the paper's field: capture": "field.capture_rate:.3f",
        "crash": "field.crash_rate:.3f",
        "steps": "field.capture_step:.0f",
        "held-out evaders, layouts": "held_out.layouts.capture_rate:.3f",
        "held-out evaders, uniform tasks": "held_out.uniform.capture_rate:.3f",
        "their crashes": "held_out.layouts.crash_rate:.3f",
        "worst evader, uniform tasks": "worst.uniform",
        "worst evader, layouts": "worst.layouts",
    }
    rows = [dict(zip(CASE, name, strict=True)) | overview(own) for name, own in by_policy.items()]
    parts: list[Table | str] = [from_outside(), Table(columns, rows, title="Overview")]
    parts += [*told(results, "findings", "What was found"), everyone(by_policy)]
    for name, own in by_policy.items():
        if name[0] == DEFAULT_POLICY:
            parts.append(by_evader(own, f"{name[0]}, {name[1]} game, {name[2]} vehicle"))
    if "runs" in results:
        parts.append(whole_runs(results["runs"]))
    parts += told(results, "tried", "What else was tried") + told(
        results, "commands", "Commands, commits, machines"
    )
    prose = (
        "Capture rate, crash rate. Vehicles: the nominal one; `table`, slower (motors by 40 ms, "
        "commands 15 ms and poses 10 ms late, drag); `family`, drawn as in training. Uniform tasks "
        "are drawn ones that nobody trained on. Held-out evaders were never trained on, nor were "
        "checkpoints chosen by them. Crashes count to the end of the 8 s, after the capture too."
    )
    return Page("Policies against evaders", prose, parts, summary_table(by_policy))


def from_outside() -> Table:
    """What somebody else measured with evaders of other code (evaders_outside.json)."""
    stored = read_json(RESULTS / "evaders_outside.json")
    places = (*SCENARIOS, "uniform")

    def rate(place: str) -> Callable:
        return lambda row: f"{row['capture_rate'][place]:.2f}".removeprefix("0")

    columns = {"evaders from outside": "evader", **{place: rate(place) for place in places}}
    prose = (
        f"Tried from outside, at {stored['commit']} on {stored['machine']}, with evaders of other "
        f"code: {stored['episodes_a_layout']} episodes a layout, {stored['uniform_tasks']} uniform "
        f"tasks. {stored['note']} {stored['reading'][0]}"
    )
    return Table(columns, stored["rows"], "What evaders from outside find", prose)


def summary_table(by_policy: dict[tuple, list[dict]]) -> Table:
    """What stands on the page: evaders from outside, then this package's own scripted
    ones.
    """
    outside = from_outside()
    records = by_policy.get((DEFAULT_POLICY, "honest", "nominal"), [])
    rows = list(outside.records)
    trained = [name for name in SCRIPTED if name not in HELD_OUT]
    for name, evaders in (("six that no training met", HELD_OUT), ("the other six", trained)):
        least = {}
        for place in (*SCENARIOS, "uniform"):
            cell = [r for r in records if r["tasks"] == place and r["evader"] in evaders]
            least[place] = min((r["capture_rate"] for r in cell), default=math.nan)
        rows.append({"evader": f"own scripted evaders, {name}", "capture_rate": least})
    return Table(outside.columns, rows)


def told(results: dict, name: str, title: str) -> list[str]:
    """A section of what is told in words, if anything is."""
    found = results.get(name, ())
    lines = [
        f"* {line}: {found[line]}" if isinstance(found, dict) else f"* {line}" for line in found
    ]
    return ["\n".join([f"## {title}", "", *lines])] if lines else []


def overview(records: list[dict]) -> dict:
    """Of one policy and vehicle: the paper's evader on the layouts, the held-out ones,
    the worst cells.
    """
    places = {"layouts": [r for r in records if r["tasks"] in SCENARIOS]}
    places["uniform"] = [r for r in records if r["tasks"] == "uniform"]

    def mean(rows, evaders):
        own = [row for row in rows if row["evader"] in evaders]
        names = ("capture_rate", "crash_rate", "capture_step")
        return {name: np.mean([row[name] for row in own]) for name in names}

    def worst(rows):
        row = min(rows, key=lambda row: row["capture_rate"])
        return f"{row['capture_rate']:.3f} ({row['evader']}, {row['tasks']})"

    return {
        "field": mean(places["layouts"], ["field"]),
        "held_out": {name: mean(rows, HELD_OUT) for name, rows in places.items()},
        "worst": {name: worst(rows) for name, rows in places.items()},
    }


def everyone(by_policy: dict[tuple, list[dict]]) -> Table:
    """Captures of each evader by each policy in the layouts."""
    rows = []
    for (policy, game, vehicle), records in by_policy.items():
        if (game, vehicle) == ("honest", "nominal"):
            rows.append({"policy": policy})
            for evader in SCRIPTED:
                own = [r for r in records if r["evader"] == evader and r["tasks"] in SCENARIOS]
                captures, episodes = (
                    sum(r[name] for r in own) for name in ("captures", "episodes")
                )
                low, high = wilson(captures, episodes)
                rows[-1][evader] = f"{captures / episodes:.2f} [{low:.2f}, {high:.2f}]"
    prose = "Captures in the six layouts, 95 % interval; honest game, nominal vehicle."
    return Table(
        {name: name for name in ("policy", *SCRIPTED)}, rows, "Everyone against everyone", prose
    )


def by_evader(records: list[dict], title: str) -> Table:
    """A row for each evader, a column for each kind of tasks."""
    rows = []
    for evader in dict.fromkeys(record["evader"] for record in records):
        own = {record["tasks"]: record for record in records if record["evader"] == evader}
        rates = {name: f"{r['capture_rate']:.3f}, {r['crash_rate']:.3f}" for name, r in own.items()}
        least = min(wilson(r["captures"], r["episodes"])[0] for r in own.values())
        rows.append({"evader": evader, "of": EVADERS[evader].of, **rates, "low": least})
    columns = {"evader": "evader", "used for": "of", **{name: name for name in own}}
    prose = "The last column is the least lower end of the capture rates' 95 % intervals."
    return Table(columns | {"least lower end": "low:.3f"}, rows, title, prose)


def whole_runs(runs: list[dict]) -> Table:
    """What training runs scored on their validation tasks, where best and at the
    end.
    """
    rows = []
    for run in runs:
        shown = (max(run["validations"], key=lambda row: row["score"]), run["validations"][-1])
        rows += [{"run": run["run"], **row} for row in shown]
    columns = {"run": "run", "M steps": "millions:.0f", "s": "seconds:.0f", "score": "score:.3f"}
    columns |= {
        "capture": "capture_rate:.3f",
        "crash": "crash_rate:.3f",
        "breaches": "collision_rate:.4f",
    }
    prose = (
        "Tasks of the validation, never trained on, with drawn vehicles: a run's best and its last. "
        "s counts compilation."
    )
    title = f"Training, validated against field, {', '.join(VALIDATED)}"
    return Table(columns, rows, title=title, prose=prose)


def main(arguments: list[str]) -> int:
    """Evaluate and write both files."""
    parser = page_parser(__doc__, "evaders")
    parser.add_argument(
        "--policy", nargs="+", default=["flight", "evaders"], help="names, runs or files"
    )
    parser.add_argument("--game", choices=GAMES, default="honest")
    parser.add_argument("--physics", choices=("rigid", "stops"), default="rigid")
    parser.add_argument("--vehicles", nargs="+", default=["nominal", "table", "family"])
    parser.add_argument("--episodes", type=int, default=100, help="per layout")
    parser.add_argument("--uniform", type=int, default=256, help="uniform tasks")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

"""Policies against every evader: `python -m experiments.evaders.cross_play --policy NAME ... [--game own|honest]`.

All evaders by name, on the six layouts and on uniform tasks, with the nominal vehicle, a slower one and the family of the
preset `flight`. Nothing is chosen by any of it; held-out evaders were never trained on. Game "own": the policy's; "honest": no
clamp on the speed, the rate loop at 500 Hz. Writes experiments/results/evaders.json and .md (`--out`: others).
"""

import dataclasses
import functools
from collections import defaultdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.flying.vehicles import FLIGHT_FAMILY, vehicles
from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots, repeat_task
from openjax.commands.validation import uniform_tasks
from openjax.files import read_json
from openjax.learning.best_response import make_duel
from openjax.pursuit import (
    SCENARIOS,
    EpisodeStatistics,
    Pursuit,
    PursuitSettings,
    RewardSettings,
    Task,
    scenario_task,
)
from openjax.pursuit.evaders import EVADERS, SCRIPTED
from openjax.store.policies import LoadedPolicy, load_policy

ALL = SCRIPTED


@functools.cache
def program(settings: PursuitSettings, policy):
    """Compiled episodes; see `make_duel`."""
    return jax.jit(make_duel(Pursuit(settings), policy))


def game_of(loaded: LoadedPolicy, game: str, physics: str) -> PursuitSettings:
    """The policy's game with all evaders and the family of vehicles; see the module."""
    settings = loaded.settings.environment
    settings = dataclasses.replace(
        settings,
        evaders=ALL,
        physics=physics,
        vehicles=FLIGHT_FAMILY,
        rare_vehicles=0.5,
        max_pillars=layout_slots(settings),
        reward=RewardSettings(),  # counts for nothing here: the same program for policies that differ in it
    )
    if game == "own":
        return settings
    return dataclasses.replace(settings, speed_limit="none", substeps=5)


def tasks_of(settings: PursuitSettings, layouts: int, uniform: int) -> tuple[list[str], list[int], Task]:
    """Names of the kinds of tasks, how many of each, and all of them one after the other."""
    parts = [repeat_task(scenario_task(settings, scenario), layouts) for scenario in SCENARIOS.values()]
    drawn = dataclasses.replace(settings, min_pillars=4, max_pillars=5)
    parts.append(uniform_tasks(drawn, uniform, settings.max_pillars))
    tasks = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return [*SCENARIOS, "uniform"], [layouts] * len(SCENARIOS) + [uniform], tasks


def fly(name: str, options) -> list[dict]:
    """A record for each vehicle, evader and kind of task."""
    loaded = load_policy(name)
    settings = game_of(loaded, options.game, options.physics)
    kinds, counts, tasks = tasks_of(settings, options.episodes, options.uniform)
    run = program(settings, loaded.in_game(Pursuit(settings)).policy)
    number = sum(counts)
    repeated = jax.tree.map(lambda leaf: jnp.tile(leaf, (len(ALL), *[1] * (leaf.ndim - 1))), tasks)
    evaders = jnp.repeat(jnp.arange(len(ALL)), number)
    records = []
    for vehicle in options.vehicles:
        bounds = jnp.asarray(vehicles()[vehicle])
        found = jax.tree.map(
            np.asarray,
            run(loaded.parameters, repeated, evaders, jax.random.key(0), {"vehicle_bounds": bounds}),
        )
        for i, evader in enumerate(ALL):
            start = i * number
            for kind, count in zip(kinds, counts, strict=True):
                part = jax.tree.map(lambda leaf, s=start, n=count: leaf[s : s + n], found)
                start += count
                case = {
                    "policy": name,
                    "game": options.game,
                    "vehicle": vehicle,
                    "evader": evader,
                    "tasks": kind,
                }
                records.append(case | {"of": EVADERS[evader].of} | summary(part))
    return records


def summary(statistics: EpisodeStatistics) -> dict:
    """Counts and means over episodes, with Wilson's 95 % interval of the capture rate."""
    number, captures = len(statistics.captured), int(statistics.captured.sum())
    return {
        "episodes": number,
        "captures": captures,
        "capture_rate": captures / number,
        "interval": wilson(captures, number),
        "crash_rate": float(statistics.crashed.mean()),
        "capture_step": float(statistics.capture_step.mean()),
        "collision_rate": float((statistics.collision_steps / statistics.steps).mean()),
        "over_speed_rate": float((statistics.over_speed_steps / statistics.steps).mean()),
    }


def wilson(successes: int, number: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson 1927)."""
    z = 1.959964
    share = successes / number
    middle = (share + z**2 / (2 * number)) / (1 + z**2 / number)
    half = z / (1 + z**2 / number) * (share * (1 - share) / number + z**2 / (4 * number**2)) ** 0.5
    return max(0.0, middle - half), min(1.0, middle + half)


def study(options) -> dict:
    """Fly the policies, beside what other runs found."""
    found = [read_json(path) for path in options.add]
    records = [record for other in found if "curve" not in other for record in other["records"]]
    return {
        "records": records + [record for name in options.policy for record in fly(name, options)],
        "best_responses": [other for other in found if "curve" in other],
    }


def page(results: dict) -> Page:
    """First what matters of each policy and vehicle, then capture rates and crashes by evader and by best response."""
    records, of = results["records"], ("policy", "game", "vehicle")
    by_policy = defaultdict(list)
    for record in records:
        by_policy[tuple(record[name] for name in of)].append(record)
    columns = {
        **{name: name for name in of},
        "the paper's field: capture": "field.capture:.3f",
        "crash": "field.crash:.3f",
        "steps": "field.step:.0f",
        "mean of the held-out evaders": "held_out.mean:.3f",
        "crash, held out": "held_out.crash:.3f",
        "worst scripted evader and layout": "worst",
    }
    rows = [dict(zip(of, name, strict=True)) | overview(own) for name, own in by_policy.items()]
    parts: list[Table | str] = [Table(columns, rows, title="Overview, the six layouts")]
    for name, own in by_policy.items():
        parts.append(by_evader(own, "tasks", f"{name[0]}, {name[1]} game, {name[2]} vehicle"))
    for response in results.get("best_responses", ()):
        steps = response["curve"][-1]["steps"] / 1e6
        title = f"{response['policy']} against evaders that learned {steps:.0f} million steps against it, in its own game"
        parts.append(by_evader(response["records"], "scenario", title))
    prose = (
        "Capture rate, crash rate. The last column is the least lower end of the capture rates' 95 % intervals. "
        "Held-out evaders were never trained on, nor were checkpoints chosen by them. Crashes count to the end of the 8 s, "
        "after the capture too."
    )
    return Page("Policies against evaders", prose, parts)


def overview(records: list[dict]) -> dict:
    """Of one policy and vehicle on the layouts: the paper's evader, the held-out ones, the worst cell."""
    layouts = [record for record in records if record["tasks"] in SCENARIOS]

    def mean(rows, figure):
        return float(np.mean([row[figure] for row in rows]))

    field = [row for row in layouts if row["evader"] == "field"]
    held_out = [row for row in layouts if row["of"] == "held out"]
    worst = min(layouts, key=lambda row: row["capture_rate"])
    return {
        "field": {
            "capture": mean(field, "capture_rate"),
            "crash": mean(field, "crash_rate"),
            "step": mean(field, "capture_step"),
        },
        "held_out": {"mean": mean(held_out, "capture_rate"), "crash": mean(held_out, "crash_rate")},
        "worst": f"{worst['capture_rate']:.2f} ({worst['evader']}, {worst['tasks']})",
    }


def by_evader(records: list[dict], kind: str, title: str) -> Table:
    """A row for each evader, a column for each `kind` of tasks."""
    rows = []
    for evader in dict.fromkeys(record["evader"] for record in records):
        own = {record[kind]: record for record in records if record["evader"] == evader}
        rates = {name: f"{r['capture_rate']:.3f}, {r['crash_rate']:.3f}" for name, r in own.items()}
        low = min(wilson(round(r["capture_rate"] * r["episodes"]), r["episodes"])[0] for r in own.values())
        of = EVADERS[evader].of if evader in EVADERS else "learned against it"
        rows.append({"evader": evader, "of": of, "low": low, **rates})
    columns = {"evader": "evader", "used for": "of", **{name: name for name in own}}
    return Table(columns | {"least lower end": "low:.3f"}, rows, title=title)


def main(arguments: list[str]) -> int:
    """Evaluate and write both files."""
    parser = page_parser(__doc__, "evaders")
    parser.add_argument("--add", nargs="*", type=Path, default=[], help="files of other runs, or of exploit")
    parser.add_argument("--policy", nargs="*", default=["flight"], help="names, runs or policy files")
    parser.add_argument("--game", choices=("own", "honest"), default="honest")
    parser.add_argument("--physics", choices=("rigid", "stops"), default="rigid")
    parser.add_argument("--vehicles", nargs="+", default=["nominal", "table", "family"])
    parser.add_argument("--episodes", type=int, default=100, help="per layout")
    parser.add_argument("--uniform", type=int, default=256, help="uniform tasks")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

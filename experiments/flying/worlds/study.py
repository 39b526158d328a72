"""Policies in worlds that aren't the simulator: six layouts, drawn starts, no clamp.

    python -m experiments.flying.worlds [--policy open flight] [--world plant rotorpy ...]
    [--held_out] [--episodes 100]

Worlds: `plant`, the exam's plant, and with `plant:motor_lag` and so on each of its
causes at three quarters of its range; `rotorpy`, RotorPy's own Crazyflie. With
`--held_out` each episode draws one of the held-out evaders instead of the paper's.
Beside them: the simulator itself, `experiments.flying.vehicles`. Writes
experiments/results/worlds.json and .md (--out).
"""

import argparse
import dataclasses
import functools
import math
import os
import time
from collections import defaultdict

import jax
import numpy as np
from scipy.stats import binomtest

from experiments.diagnosis import effects
from experiments.flying.single_thread import share_out
from experiments.flying.worlds.game import play
from experiments.flying.worlds.plant import PlantWorld, rng_of
from experiments.flying.worlds.rotorpy import RotorPyWorld
from experiments.table import Column, Page, Table, page_parser, publish
from openjax.evaluation.evaluator import layout_slots
from openjax.pursuit import SCENARIOS, scenario_task
from openjax.pursuit.evaders import HELD_OUT
from openjax.store.policies import load_policy

SEED = 500  # of the plant's and RotorPy's sensors; used for nothing else
PLAIN = ("plant", "rotorpy")
SIZES = {
    "motor_lag": 2.8,  # time constant 95 ms instead of 25
    "command_latency": 46.0,  # ms
    "state_latency": 46.0,  # ms
    "packet_loss": 0.38,
    "rotor_drag": 0.024,  # N s/m
    "wind": 2.3,  # m/s
    "battery_sag": 0.3,  # of the thrust per volt
    "thrust_scale": 0.155,
    "thrust_saturation": 0.66,  # of the room above hover: the rotors top out at 0.75
    "com_offset": 6.0,  # mm
    "motor_imbalance": 0.11,
    "yaw_torque": 0.64,  # 0.36 or 1.64 times the nominal
    "rate_gains": 0.62,  # P 1.62 or 0.62 times the nominal
    "downwash": 16.0,  # g
}
"""Of the causes, in the plant's own unit."""
CAUSES = tuple(f"plant:{effect}" for effect in SIZES)
WORST = 4
"""Causes with rows of their own on the page."""
FIGURES = ("captured", "capture_step", "collision_rate", "crashed", "over_speed_rate")


@dataclasses.dataclass(frozen=True)
class Job:
    """Episodes `start` to `start + number` of a policy in a layout of a world."""

    policy: str
    held_out: bool
    world: str
    layout: str
    start: int
    number: int


def make_world(world: str, ticks: int, start: int, drones, tasks):
    """The world of that name for the drones (W, N, ...) of episodes `start` and on."""
    name, _, effect = world.partition(":")
    if name == "rotorpy":
        return RotorPyWorld(drones, tasks, ticks, SEED, first=start)
    if name != "plant" or (effect and effect not in SIZES):
        raise SystemExit(f"world {world!r} is unknown; known: {', '.join((*PLAIN, *CAUSES))}")
    number = 0 if not effect else 1 + list(SIZES).index(effect)
    cause = None
    if effect:
        form = effects.EFFECTS[effect].forms[0]
        cause = effects.draw(rng_of(SEED, number, 5), effect, form) | {"size": SIZES[effect]}
    return PlantWorld(drones, tasks, ticks, SEED, number, cause, first=start)


@functools.cache
def loaded_policy(name: str, held_out: bool):
    """A policy, and its game without clamp and family, with the paper's evader or
    held-out ones.
    """
    policy = load_policy(name)
    settings = dataclasses.replace(
        policy.settings.environment,
        speed_limit="none",
        start_attitude="drawn",
        physics="rigid",
        evaders=HELD_OUT if held_out else ("field",),
        vehicles=(),
        rare_vehicles=0.0,
        max_pillars=layout_slots(policy.settings.environment),
    )
    return policy, settings


def do(job: Job) -> tuple[Job, dict[str, list[float]], float]:
    """Figures of each episode of a job, and how long they took (s)."""
    begin = time.perf_counter()
    loaded, settings = loaded_policy(job.policy, job.held_out)
    task = scenario_task(settings, SCENARIOS[job.layout])
    tasks = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], job.number, axis=0), task)
    numbers = np.arange(job.start, job.start + job.number)
    keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(SEED)))(numbers)
    make = functools.partial(make_world, job.world, settings.episode_length, job.start)
    statistics = play(loaded, settings, tasks, keys, make)
    figures = {name: np.asarray(getattr(statistics, name), float).tolist() for name in FIGURES}
    return job, figures, time.perf_counter() - begin


def study(options: argparse.Namespace) -> dict:
    """Fly all policies in all layouts of all worlds."""
    started = time.monotonic()
    jobs = [
        Job(
            policy,
            options.held_out,
            world,
            layout,
            start,
            min(options.chunk, options.episodes - start),
        )
        # the slowest first
        for world in sorted(options.world, key=lambda name: name != "rotorpy")
        for policy in options.policy
        for layout in options.layout
        for start in range(0, options.episodes, options.chunk)
    ]
    found = defaultdict(lambda: defaultdict(list))
    records = {}
    results = share_out(do, [(job,) for job in jobs], min(options.jobs, len(jobs)), options.seconds)
    for number, (job, figures, seconds) in enumerate(results, 1):
        policy = f"{job.policy}, held-out evaders" if job.held_out else job.policy
        place = found[policy, job.world, job.layout]
        places = records.setdefault(policy, {}).setdefault(job.world, {})
        for name, values in figures.items():
            place[name] += values
        means = " ".join(f"{name} {np.mean(values):.3f}" for name, values in figures.items())
        of = f"{number}/{len(jobs)} {job.policy} {job.world} {job.layout} {job.start}"
        print(
            f"{of} {means} ({seconds:.0f} s, {time.monotonic() - started:.0f} s in all)", flush=True
        )
        record = {"episodes": len(place["crashed"])}
        places[job.layout] = record | {name: float(np.mean(place[name])) for name in FIGURES}
    return {"records": records}


def page(results: dict) -> Page:
    """A row per layout and the mean over them, for each policy in each world."""
    rows = []
    for world in next(iter(results["records"].values())):
        for policy, worlds in results["records"].items():
            records = worlds.get(world, {})
            about = {"world": world, "policy": policy}
            for layout, record in records.items():
                rates = {name: f"{record[name]:.3f}" for name in ("captured", "crashed")}
                rows.append({**about, "layout": layout, **record, **rates})
            if records:
                mean = {
                    name: np.mean([record[name] for record in records.values()]) for name in FIGURES
                }
                mean["episodes"] = sum(record["episodes"] for record in records.values())
                for name in ("captured", "crashed"):
                    hits = binomtest(round(mean[name] * mean["episodes"]), mean["episodes"])
                    low, high = hits.proportion_ci(method="wilson")
                    mean[name] = f"{mean[name]:.3f} [{low:.2f}, {high:.2f}]"
                rows.append({**about, "layout": "**mean**", **mean})
    columns = {
        **{name: name for name in ("world", "policy", "layout", "episodes")},
        "capture": "captured",
        "step": "capture_step:.0f",
        "collision": "collision_rate:.4f",
        "crash": "crashed",
        "over speed": "over_speed_rate:.3f",
    }
    return Page(
        "Policies in worlds that aren't the simulator",
        "No clamp, drawn starts. Nominal: the simulator with the rate loop at 500 Hz; table: the "
        "same with motors 40 ms "
        "slower, commands 15 ms and poses 10 ms late, and drag of .0125 N s/m; plant: the exam's "
        "plant (1 kHz, no shared "
        "code), also with each of its causes at three quarters of its range; rotorpy: RotorPy's "
        "own Crazyflie.",
        Table(columns, rows),
        overview(results["records"]),
    )


def overview(records: dict) -> Table:
    """A row per world, columns of captures and crashes by policy, mean over the
    layouts; of the plant's causes only the worst, and their mean.
    """

    def mean(policy: str, world: str, figure: str) -> float:
        layouts = records[policy].get(world, {})
        return float(np.mean([r[figure] for r in layouts.values()])) if layouts else math.nan

    worlds_flown = dict.fromkeys(world for worlds in records.values() for world in worlds)
    shown = [world for world in worlds_flown if ":" not in world]
    rows = []
    for world in shown:
        rates = {(p, f): mean(p, world, f) for p in records for f in ("captured", "crashed")}
        rows.append({"world": world, **rates})
    causes = [world for world in worlds_flown if ":" in world]
    first = next(iter(records))
    if causes:
        rates = {
            (first, f): float(np.mean([mean(first, w, f) for w in causes]))
            for f in ("captured", "crashed")
        }
        rows.append({"world": f"plant, mean of {len(causes)} causes", **rates})
        worst = sorted(causes, key=lambda world: -mean(first, world, "crashed"))[:WORST]
        for world in worst:
            rates = {(first, f): mean(first, world, f) for f in ("captured", "crashed")}
            rows.append({"world": world.replace(":", ", "), **rates})
    columns: dict[str, Column] = {"world": "world"}
    for policy in records:
        for word, figure in (("captures", "captured"), ("crashes", "crashed")):
            columns[f"{policy}: {word}"] = _format((policy, figure))
    return Table(columns, rows)


def _format(key: tuple[str, str]) -> Column:
    """A column of the rate that stands under `key`, or a dash."""

    def show(row: dict) -> str:
        rate = row.get(key, math.nan)
        return f"{rate:.3f}" if math.isfinite(rate) else "–"

    return show


def main() -> None:
    """Fly, or read, and write the page."""
    parser = page_parser(__doc__, "worlds")
    parser.add_argument(
        "--policy", nargs="+", default=["open", "flight"], help="names, runs or policy files"
    )
    parser.add_argument(
        "--world", nargs="+", default=list(PLAIN), help=", ".join((*PLAIN, *CAUSES))
    )
    parser.add_argument("--held_out", action="store_true", help="against the held-out evaders")
    parser.add_argument("--layout", nargs="+", default=list(SCENARIOS))
    parser.add_argument("--episodes", type=int, default=100, help="per layout")
    parser.add_argument(
        "--chunk", type=int, default=50, help="episodes that one process flies at once"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--seconds", type=float, default=math.inf, help="begin nothing new after this long"
    )
    publish(parser.parse_args(), study, page)

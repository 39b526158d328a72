"""The quick preset as a user with two cores meets it: the whole command, installed but nothing
compiled, for several seeds.

    python -m experiments.paper.quick [--seeds 0 1 2] [--at_once 1] [--options "..."]

Each run has two cores of its own and an empty cache. Its policy is then flown on the validation
tasks once more, with captures and crashes looked for in every physics step, and not only at those
at which the policy steers.
"""

import argparse
import dataclasses
import functools
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp

from experiments.table import Page, Table, page_parser, publish
from openjax.evaluation.validation import uniform_tasks
from openjax.files import read_json
from openjax.learning.presets import PRESETS
from openjax.pursuit import SCENARIOS, Pursuit
from openjax.store.policies import LoadedPolicy, load_policy

CORES = 2


def train(options: argparse.Namespace, seed: int, cores: list[int]) -> dict:
    """One run on those cores: what its table says, and the seconds of the whole command."""
    run = options.runs / f"seed_{seed}"
    command = [sys.executable, "-m", "openjax.train", "--preset", "quick", "--seed", str(seed)]
    command += ["--out", str(run), "--overwrite", "--no-compilation_cache"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    # JAX sets the latter here, a user doesn't
    for name in ("JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL"):
        environment.pop(name, None)
    start = time.monotonic()
    with open(f"{run}.txt", "w") as log:
        pinned = ["taskset", "-c", ",".join(map(str, cores)), *command, *options.options.split()]
        subprocess.run(pinned, env=environment, stdout=log, stderr=subprocess.STDOUT, check=True)
    seconds = round(time.monotonic() - start)
    print(f"seed {seed}: {seconds} s", flush=True)
    return {"seed": seed, "jax": jax.__version__, "whole_command": seconds, **record(run)}


def record(run: Path) -> dict:
    """What the table of a run says, and its policy flown on the validation tasks once more."""
    layouts = read_json(run / "layouts.json")
    policy = load_policy(run)
    figures = {
        name: layouts[name] for name in ("after", "open", "seconds", "steps") if name in layouts
    }
    step = policy.settings.environment.time_step
    return {"time_step": step, **figures, "every_physics_step": fly_finely(policy)}


def fly_finely(loaded: LoadedPolicy) -> dict[str, float]:
    """Rates on the validation tasks in an environment whose step is one physics step, the policy's
    action held between.
    """
    own = loaded.settings.environment
    substeps = loaded.settings.environment.substeps
    game = Pursuit(
        dataclasses.replace(
            own,
            time_step=own.time_step / substeps,
            substeps=1,
            episode_length=own.episode_length * substeps,
            history_spacing=own.history_spacing * substeps,
        )
    )
    tasks = uniform_tasks(own, loaded.settings.validation_episodes, own.max_pillars)
    keys = jax.random.split(jax.random.key(0), loaded.settings.validation_episodes)

    @jax.jit
    def episodes(keys, tasks):
        def one(carry, _):
            observation, state = carry
            action = loaded(observation)
            for _ in range(substeps):
                observation, state, *_ = jax.vmap(game.step, (None, 0, 0))(
                    jax.random.key(0), state, action
                )
            return (observation, state), None

        start = jax.vmap(game.reset_to)(keys, tasks)
        return jax.lax.scan(one, start, None, length=own.episode_length)[0][1].statistics

    statistics = episodes(keys, tasks)
    return {
        "capture_rate": float(jnp.mean(statistics.captured)),
        "crash_rate": float(jnp.mean(statistics.crashed)),
        "capture_seconds": float(jnp.mean(statistics.capture_step)) * own.time_step / substeps,
    }


def study(options: argparse.Namespace) -> dict:
    """All runs."""
    options.runs.mkdir(parents=True, exist_ok=True)
    available = sorted(os.sched_getaffinity(0))
    places = [available[CORES * i : CORES * (i + 1)] for i in range(options.at_once)]
    with ThreadPoolExecutor(options.at_once) as pool:
        cores = itertools.cycle(places)
        runs = list(pool.map(functools.partial(train, options), options.seeds, cores))
    return {"preset": " ".join(PRESETS["quick"].__doc__.split()), "runs": runs}


def page(results: dict) -> Page:
    """A row per seed of today's recipe."""
    prose = f"{results['preset']} {results.get('note', '')}"
    runs = [run for run in results["runs"] if "recipe" not in run]
    return Page("The quick preset: what two CPU cores learn", prose, Table(SHOWN, runs[:MOST]))


def _rate(figure: str, *scenarios: str) -> Callable[[dict], str]:
    """A column: the least of a figure over kinds of task."""

    def show(run):
        return f"{min(row[figure] for row in run['after'] if row['scenario'] in scenarios):.2f}"

    return show


MOST = 10
"""Rows of the page."""
SHOWN = {
    "seed": "seed",
    "JAX": "jax",
    "whole command, s": "whole_command",
    "new tasks caught": _rate("capture_rate", "validation"),
    "... crash, in every step of the physics": "every_physics_step.crash_rate:.2f",
    "least caught in a layout": _rate("capture_rate", *SCENARIOS),
    "crash in `random`": _rate("crash_rate", "random"),
}


def main() -> None:
    """The command."""
    parser = page_parser(__doc__, "quick")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--at_once", type=int, default=1, help="runs side by side, on two cores each"
    )
    parser.add_argument("--options", default="", help="more options of openjax.train")
    parser.add_argument("--runs", type=Path, default=Path("runs/quick"), help="folder of the runs")
    publish(parser.parse_args(), study, page)


if __name__ == "__main__":
    main()

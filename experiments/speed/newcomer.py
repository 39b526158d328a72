"""Seconds that somebody new waits for on a CPU, and steps a second of Gymnasium's vector
environments: `python -m experiments.speed.newcomer`.

Commands are whole processes, each timed after one run that isn't counted, so that compiled programs
are kept. Beside the game stands a peer of Gymnasium's own.
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time

import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command

COMMANDS = {
    "import openjax": ("≤ 1", "-c", "import openjax"),
    "import openjax; openjax.make()": ("–", "-c", "import openjax; openjax.make()"),
    "openjax --help": ("≤ 0.5", "-m", "openjax", "--help"),
    "openjax evaluate --scenario empty --episodes 1": (
        *("≤ 5", "-m", "openjax", "evaluate", "--scenario", "empty", "--episodes", "1"),
    ),
    "openjax evaluate --scenario empty, 100 episodes": (
        *("≤ 5", "-m", "openjax", "evaluate", "--scenario", "empty"),
    ),
    "openjax evaluate, 100 episodes of six layouts": ("–", "-m", "openjax", "evaluate"),
}
"""The goal in seconds of each, and what Python is told."""
STEPS = 200
LEARNT = 8192
"""Steps that Stable-Baselines3 learns, four of its rollouts."""


def seconds(arguments: tuple[str, ...], runs: int, cache: str) -> list[float]:
    """Wall-clock seconds of each run of Python but the first."""
    environment = {**os.environ, "XDG_CACHE_HOME": cache, "JAX_PLATFORMS": "cpu"}
    took = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, *arguments], env=environment, check=True, stdout=subprocess.DEVNULL
        )
        took.append(time.perf_counter() - began)
    return took[1:]


def steps_a_second(environment, number: int) -> float:
    """World steps a second of a Gymnasium vector environment that is told random actions."""
    environment.action_space.seed(0)
    environment.reset(seed=0)
    actions = [environment.action_space.sample() for _ in range(STEPS)]
    environment.step(actions[0])
    best = np.inf
    for _ in range(3):
        began = time.perf_counter()
        for action in actions:
            environment.step(action)
        best = min(best, time.perf_counter() - began)
    return number * STEPS / best


def learned_steps_a_second(name: str) -> float:
    """Steps a second of Stable-Baselines3's PPO on one environment, with its own settings."""
    import gymnasium
    import torch
    from stable_baselines3 import PPO

    torch.set_num_threads(1)  # two of its own take so small networks several times as long
    model = PPO("MlpPolicy", gymnasium.make(name), device="cpu", seed=0)
    model.learn(model.n_steps)  # compiles
    began = time.perf_counter()
    model.learn(LEARNT)
    return LEARNT / (time.perf_counter() - began)


def study(options: argparse.Namespace) -> dict:
    """All rows."""
    import gymnasium

    import openjax.interfaces  # noqa: F401  Gymnasium knows the game from here on

    with tempfile.TemporaryDirectory() as cache:
        waits = [
            {"what": what, "goal": goal, "seconds": seconds(tuple(arguments), options.runs, cache)}
            for what, (goal, *arguments) in COMMANDS.items()
        ]
    speeds = []
    for name in ("openjax/Pursuit-v0", "CartPole-v1"):
        for number in (64, 1024):
            way = "vector_entry_point" if name.startswith("openjax") else "sync"
            environment = gymnasium.make_vec(name, number, vectorization_mode=way)
            rate = steps_a_second(environment, number)
            speeds.append({"what": f"{name}, {number} worlds", "steps": rate})
    lacks = [name for name in ("stable_baselines3", "mpe2") if not importlib.util.find_spec(name)]
    if "stable_baselines3" not in lacks:
        for name in ("openjax/Pursuit-v0", "Pendulum-v1"):
            rate = learned_steps_a_second(name)
            speeds.append({"what": f"Stable-Baselines3's PPO, {name}", "steps": rate})
    return {"waits": waits, "speeds": speeds, "lacks": lacks}


def page(results: dict) -> Page:
    """Medians."""
    rows = [
        {**row, "median": f"{np.median(row['seconds']):.2f} s", "goal": row["goal"]}
        for row in results["waits"]
    ]
    rows += [
        {**row, "median": f"{row['steps']:,.0f} steps/s", "goal": "–"} for row in results["speeds"]
    ]
    columns = {"what": "what", "goal, s": "goal", "median": "median"}
    lacks = ", ".join(results["lacks"]) or "nothing"
    return Page(
        "What somebody new waits for", f"Not installed here: {lacks}.", Table(columns, rows)
    )


def main(arguments: list[str]) -> int:
    """Measure, write both files."""
    parser = page_parser(__doc__, "newcomer")
    parser.add_argument("--runs", type=int, default=5, help="of each command that count")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

"""What helps to predict the evader where it is hidden? `python -m experiments.prediction [--policy open]`.

Flies a fixed policy on training tasks, trains variants of the predictor on these flights, all for as many updates,
and compares them on other training tasks and on the six layouts: 10 to 400 ms ahead, where the evader is seen and where it is
hidden, beside guesses without learning. Then flies the policy on the layouts with other predictions than its own's.
Writes experiments/results/prediction.json, .md and .png; `--report` writes the last two again from the first.
"""

import argparse
import dataclasses
import os
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from experiments import prediction_flights as flying
from experiments.pages import page_parser, publish
from experiments.prediction_report import draw, report
from experiments.predictors import (
    HORIZONS,
    VARIANTS,
    VISIBILITY,
    Budget,
    compared_times,
    errors,
    lost_steps,
    predict,
    simple_guesses,
    train,
    visibility,
)
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots
from openjax.pursuit import SCENARIOS, Pursuit
from openjax.store.policies import load_policy

EXPANSIONS = 20


def study(options: argparse.Namespace) -> dict:
    """Fly, train, compare: everything that the report shows, as plain values."""
    started = time.monotonic()
    loaded = load_policy(options.policy)
    slots = layout_slots(loaded.settings.environment)
    drawn = loaded.settings.environment
    if options.episode_length:
        drawn = dataclasses.replace(drawn, episode_length=options.episode_length)
    settings = dataclasses.replace(drawn, max_pillars=slots)
    number = options.worlds + options.held_back
    tasks = flying.with_slots(flying.training_tasks(drawn, jax.random.key(11), number, EXPANSIONS), slots)
    layouts = flying.layout_tasks(settings, options.episodes)
    sources = len(flying.SOURCES) if loaded.policy.predictor.enabled else 1
    tasks = jax.tree.map(lambda a, b: jnp.concatenate([a, *[b] * sources]), tasks, layouts)
    per_source = len(SCENARIOS) * options.episodes
    flights, outcome = flying.fly(
        Pursuit(settings),
        loaded.policy,
        loaded.parameters,
        tasks,
        jnp.concatenate([jnp.zeros(number, jnp.int32), jnp.repeat(jnp.arange(sources), per_source)]),
        jnp.arange(number + sources * per_source) < options.worlds,  # only training flights explore
        jax.random.key(12),
    )
    flown = jax.tree.map(lambda leaf: leaf[: options.worlds], flights)
    test = jax.tree.map(lambda leaf: leaf[options.worlds : number + per_source], flights)
    groups = np.concatenate([np.zeros(options.held_back, int), 1 + np.arange(per_source) // options.episodes])
    times = compared_times(settings.episode_length, options.stride)
    budget = Budget(options.updates, options.batch, options.seeds)
    lost = lost_steps(flown)
    seconds = {"flights": time.monotonic() - started}

    def compare(variant):
        parameters, loss = train(variant, settings, budget, flown, lost)
        predicted = predict(variant, settings, parameters, test, options.stride)
        return {
            **dataclasses.asdict(variant),
            "loss": np.asarray(loss).tolist(),
            "parameters": sum(leaf.size for leaf in jax.tree.leaves(parameters)) // options.seeds,
            "errors": plain(errors(predicted, variant.horizons, test, times, groups)),
        }

    # side by side, so that one variant compiles while another one trains
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        variants = list(pool.map(compare, VARIANTS[: options.variants]))
    guesses = simple_guesses(settings, test, times)
    guesses["the evader's own rule"] = flying.evader_rule(settings, test, times, HORIZONS)
    guesses = {name: plain(errors(guess, HORIZONS, test, times, groups)) for name, guess in guesses.items()}
    kinds = visibility(test, times)
    share = kinds.mean(axis=1)
    fewer = "" if options.variants >= len(VARIANTS) else f" --variants {options.variants}"
    outcome = np.asarray(outcome[number:]).reshape(sources, len(SCENARIOS), options.episodes, 3).mean(axis=2)
    return {
        "command": f"python -m experiments.prediction --policy {options.policy} --worlds {options.worlds} "
        f"--held-back {options.held_back} --episodes {options.episodes} --updates {options.updates} "
        f"--batch {options.batch} --seeds {options.seeds} --stride {options.stride}{fewer}",
        "note": options.note,
        "seconds": {**seconds, "whole": time.monotonic() - started},
        "time_step": settings.time_step,
        "horizons": HORIZONS,
        "groups": ["training tasks", *SCENARIOS],
        "visibility": VISIBILITY,
        "share": [plain(share[groups == g].mean(axis=0)) for g in range(len(SCENARIOS) + 1)],
        "lost_steps": [int(kinds[groups == g, :, 1].sum()) for g in range(len(SCENARIOS) + 1)],
        "variants": variants,
        "guesses": guesses,
        "told": {name: outcome[i].tolist() for i, name in enumerate(flying.SOURCES[:sources])},
        "worlds": [options.worlds, options.held_back, options.episodes],
        "budget": dataclasses.asdict(budget),
    }


def plain(values: np.ndarray) -> list:
    """Nested lists to a hundredth of a millimetre, None for NaN."""
    rounded = np.round(values.astype(float), 5)
    return np.where(np.isnan(rounded), None, rounded.astype(object)).tolist()


def main(arguments: list[str]) -> int:
    """Study or read it, write the three files, print the page."""
    parser = page_parser(__doc__, "prediction")
    parser.add_argument("--policy", default="open", help="a shipped policy, a run or a policy file")
    parser.add_argument("--worlds", type=int, default=8192, help="episodes to train on")
    parser.add_argument("--held-back", type=int, default=4096, help="other training tasks to compare on")
    parser.add_argument("--episodes", type=int, default=100, help="per layout")
    parser.add_argument("--updates", type=int, default=4000)
    parser.add_argument("--batch", type=int, default=4096, help="windows per update")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--stride", type=int, default=4, help="compare at every so manyth step")
    parser.add_argument("--variants", type=int, default=len(VARIANTS), help="only the first so many")
    parser.add_argument("--episode-length", type=int, default=0, help="shorter episodes, to try the command")
    parser.add_argument("--note", default="")
    publish(parser.parse_args(arguments), study, report, draw)
    return 0


if __name__ == "__main__":
    run_command(main)

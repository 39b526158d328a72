"""What adapting a policy to a diagnosed vehicle wins back, in that vehicle's own world.

    python -m experiments.adapting tune --cases DIR --policy flight --work DIR     (a GPU)
    python -m experiments.adapting fly --cases DIR --policy flight --work DIR [--jobs N] [--episodes 100]     (CPU cores)

The vehicles are those of `experiments.task_gap`: the exam's plant with one cause each, their flights diagnosed by
`openjax.gap`. `--cases` holds, of each, its NAME.json and NAME.toml (the effects that were found) as task_gap writes them.
`tune` fine-tunes the policy to each; `fly` plays the same tasks in the plant with the vehicle that flew: the policy as it
was, the adapted one, and the policy as it was on the plant's nominal vehicle. Loss is the difference to the latter. Writes
experiments/results/adapting.json and .md (--out).
"""

import dataclasses
import functools
import multiprocessing
import os
import time
from pathlib import Path

import jax
import numpy as np

from experiments.pages import page_parser, publish, table, where
from experiments.task_gap.flights import make_cases
from experiments.task_gap.game import draw_tasks
from experiments.worlds.game import play
from experiments.worlds.plant import PlantWorld
from openjax.commands.machine import describe_machine
from openjax.files import read_json
from openjax.learning.adaptation import (
    AdaptSettings,
    adapting_settings,
    bounds_of,
    fine_tune,
    make_adaptation,
)
from openjax.store.policies import load_policy
from openjax.store.policy_files import save_policy_file
from openjax.vehicle.effects import load_effects
from openjax.vehicle.effects.effects_file import load_intervals

FIGURES = ("crashed", "collision_rate", "capture_step", "captured")
NOMINAL = "nominal"


def found_cases(options) -> list[str]:
    """Names of the vehicles whose diagnosis is there."""
    names = sorted(path.stem for path in options.cases.glob("*.toml"))
    return names[: options.limit] if options.limit else names


def tune(options) -> None:
    """Fine-tune the policy to each vehicle; one compilation for all."""
    started = time.monotonic()
    loaded = load_policy(options.policy)
    training = AdaptSettings(updates=options.updates)
    adaptation = make_adaptation(adapting_settings(loaded.settings, training))
    parameters = loaded.parameters.replace(critic={})
    for number, name in enumerate(found_cases(options)):
        if time.monotonic() - started > options.seconds:
            print("time is up before", name)
            break
        begin = time.monotonic()
        file = options.cases / f"{name}.toml"
        effects, values = load_effects(file)
        bounds = bounds_of(values, load_intervals(file))
        tuned, history = fine_tune(adaptation, parameters, bounds, training.warm_up, jax.random.key(number))
        notes = {"effects": list(effects), "seconds": time.monotonic() - begin}
        # the game without its family: flown elsewhere, it isn't needed, and all policies share one program
        settings = dataclasses.replace(
            adaptation.settings,
            environment=dataclasses.replace(adaptation.settings.environment, vehicles=()),
        )
        save_policy_file(options.work / f"{name}.npz", tuned.replace(critic={}), settings, notes, "float32")
        said = {key: round(history[-1][key], 4) for key in ("capture_rate", "crash_rate", "collision_rate")}
        print(f"{name}: {', '.join(effects) or 'none'}; {notes['seconds']:.0f} s {said}", flush=True)


@functools.cache
def game_of(policy: str):
    """A policy, and its game without family and clamp."""
    loaded = load_policy(policy)
    settings = dataclasses.replace(
        loaded.settings.environment, vehicles=(), rare_vehicles=0.0, speed_limit="none", physics="rigid"
    )
    return loaded, settings


def fly_one(job) -> tuple[str, str, dict[str, list[float]]]:
    """Episodes of a policy in the plant with a vehicle: (case, which policy, figures of each episode)."""
    cases, name, which, policy, episodes = job
    loaded, settings = game_of(policy)
    case = next(case for case in make_cases(1, 2, 2) if case.name == name)
    cause = None
    if case.cause is not None and which != NOMINAL:
        cause = case.cause | {"size": read_json(cases / f"{name}.json")["flown"]["size"]}
    tasks, keys = draw_tasks(settings, 0, episodes)

    def make_world(drones, tasks):
        return PlantWorld(drones, tasks, settings.episode_length, case.seed, case.number, cause)

    statistics, _ = play(loaded, settings, tasks, keys, make_world)
    return (
        name,
        which,
        {figure: np.asarray(getattr(statistics, figure), float).tolist() for figure in FIGURES},
    )


def study(options) -> dict:
    """Fly the adapted policies, and the policy as it was, in the plant."""
    started = time.monotonic()
    names = [name for name in found_cases(options) if (options.work / f"{name}.npz").exists()]
    jobs = [
        (options.cases, name, which, policy, options.episodes)
        for name in names
        for which, policy in (
            (NOMINAL, options.policy),
            ("before", options.policy),
            ("after", str(options.work / f"{name}.npz")),
        )
    ]
    found: dict[str, dict] = {}
    with multiprocessing.get_context("spawn").Pool(min(options.jobs, len(jobs))) as pool:
        for name, which, figures in pool.imap_unordered(fly_one, jobs):
            means = {figure: float(np.mean(values)) for figure, values in figures.items()}
            found.setdefault(name, {})[which] = means
            print(name, which, means, f"{time.monotonic() - started:.0f} s", flush=True)
    return {
        "command": f"python -m experiments.adapting fly --policy {options.policy} --episodes {options.episodes}",
        "machine": describe_machine(),
        "seconds": time.monotonic() - started,
        "episodes": options.episodes,
        "vehicles": {
            name: found[name] | {"found": load_effects(options.cases / f"{name}.toml")[0]} for name in names
        },
    }


def won_back(vehicles: dict, figure: str) -> tuple[float, float, float]:
    """Sum of losses before and after adapting, where the policy loses anything, and the share won back."""
    sign = -1.0 if figure == "captured" else 1.0
    losses = [
        [sign * (row[which][figure] - row[NOMINAL][figure]) for which in ("before", "after")]
        for row in vehicles.values()
    ]
    before, after = np.sum([loss for loss in losses if loss[0] > 0] or [[0.0, 0.0]], axis=0)
    return float(before), float(after), float(1 - after / before) if before > 0 else float("nan")


def report(results: dict) -> list[str]:
    """The page."""
    vehicles = results["vehicles"]
    lines = [
        "# What adapting wins back",
        "",
        f"{where(results)} {results['seconds']:.0f} s. "
        f"{len(vehicles)} vehicles of the exam's plant with one cause each, {results['episodes']} uniform tasks each, no "
        "clamp, drawn starts. Loss: the difference to the same policy on the plant's nominal vehicle, summed over the vehicles "
        "with which it loses anything.",
        "",
        *table(
            ["figure", "loss before", "loss after", "won back"],
            [
                [figure, f"{before:.3f}", f"{after:.3f}", f"{share:.2f}"]
                for figure in FIGURES
                for before, after, share in [won_back(vehicles, figure)]
            ],
        ),
        "",
        *table(
            ["vehicle", "found", *(f"{figure}: nominal, before → after" for figure in FIGURES)],
            [
                [
                    name,
                    ", ".join(row["found"]) or "none",
                    *(
                        f"{row[NOMINAL][figure]:.4g}, {row['before'][figure]:.4g} → {row['after'][figure]:.4g}"
                        for figure in FIGURES
                    ),
                ]
                for name, row in vehicles.items()
            ],
        ),
    ]
    return lines


def main() -> None:
    """Tune, or fly and write the page."""
    parser = page_parser(__doc__, "adapting")
    parser.add_argument("what", choices=("tune", "fly"))
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="where the adapted policies are")
    parser.add_argument("--policy", default="flight")
    parser.add_argument("--updates", type=int, default=AdaptSettings.updates)
    parser.add_argument("--limit", type=int, default=0, help="vehicles at most; 0: all")
    parser.add_argument("--seconds", type=float, default=1e9, help="tune nothing new after this long")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    if options.what == "tune":
        tune(options)
    else:
        publish(options, study, report)


if __name__ == "__main__":
    main()

"""What adapting a policy to a diagnosed vehicle wins back, in that vehicle's own world.

    python -m experiments.adapting tune --cases DIR --policy flight --work DIR     (a GPU)
    python -m experiments.adapting tune --cases DIR --policy flight --work OWN --long     (a GPU)
    python -m experiments.adapting fly --cases DIR --policy flight --work DIR [--own OWN] [--jobs N] [--episodes 100]

The vehicles are those of `experiments.task_gap`: the exam's plant with one cause each, their flights diagnosed by
`openjax.gap`. `--cases` holds, of each, its NAME.json and NAME.toml (the effects that were found) as task_gap writes them.
`tune` fine-tunes the policy to each as `openjax.adapt` does; with --long four times as long, and to that one vehicle without
anything else that it might be: what training for it can reach. `fly` (CPU cores) plays the same tasks in the plant with the
vehicle that flew: the policy as it was, the adapted ones, and the policy as it was on the plant's nominal vehicle. Loss is
the difference to the latter. Without --work it flies the policy as it was alone, which tells how much there is to win. Writes
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
from openjax.commands.adapt import LOSSES, compile_programs, episodes, scores_on
from openjax.commands.validation import uniform_tasks
from openjax.files import read_json
from openjax.learning.adaptation import (
    AdaptSettings,
    bounds_of,
    fine_tune,
    make_adaptation,
    starting_parameters,
)
from openjax.store.policies import load_policy
from openjax.store.policy_files import save_policy_file
from openjax.vehicle.effects import load_effects
from openjax.vehicle.effects.effects_file import load_intervals

FIGURES = ("crashed", "collision_rate", "capture_step", "captured")
NOMINAL = "nominal"
WHICH = (NOMINAL, "before", "after", "own")
ENDS = slice(None, 10), slice(-10, None)
LONG = 4
"""Times the updates of `openjax.adapt` for a vehicle's own policy."""


def found_cases(options) -> list[str]:
    """Names of the vehicles whose diagnosis is there."""
    names = sorted(path.stem for path in options.cases.glob("*.toml"))
    return names[: options.limit] if options.limit else names


def tune(options) -> None:
    """Fine-tune the policy to each vehicle; one compilation for all."""
    started = time.monotonic()
    loaded = load_policy(options.policy)
    training = AdaptSettings(
        updates=options.updates * (LONG if options.long else 1),
        learning_rate=options.learning_rate,
        follow=options.follow,
    )
    adaptation = make_adaptation(loaded.settings, training)
    parameters = starting_parameters(loaded.parameters, loaded.settings)
    game = adaptation.game
    tasks = uniform_tasks(game, options.look_at, game.max_pillars)
    compile_programs(adaptation, parameters, tasks, bounds_of({}, {}, rest=0.0))()
    print(f"compiled in {time.monotonic() - started:.0f} s", flush=True)
    for number, name in enumerate(found_cases(options)):
        if time.monotonic() - started > options.seconds:
            print("time is up before", name)
            break
        begin = time.monotonic()
        file = options.cases / f"{name}.toml"
        effects, values = load_effects(file)
        bounds = bounds_of(values, load_intervals(file))
        if options.long:
            exact = {
                effect: {key: (value, value) for key, value in own.items()} for effect, own in values.items()
            }
            bounds = bounds_of(values, exact, rest=0.0)
        key = jax.random.key(number)
        seen: list[dict[str, float]] = []
        score = scores_on(adaptation, parameters, tasks, key, bounds, seen.append)
        tuned = fine_tune(adaptation, parameters, bounds, training, key, score)
        notes = {"effects": list(effects), "seconds": time.monotonic() - begin, "update": tuned.update}
        # the game without its family: flown elsewhere, it isn't needed, and all policies share one program
        settings = dataclasses.replace(loaded.settings, environment=dataclasses.replace(game, vehicles=()))
        save_policy_file(options.work / f"{name}.npz", tuned.parameters, settings, notes, "float32")
        looks = {update: round(value, 4) for update, value in tuned.looks.items()}
        means = [np.mean([row[n] for row in tuned.history[part]]) for n in tuned.history[0] for part in ENDS]
        learnt = "; ".join(
            f"{n} {one:.4f} → {two:.4f}"
            for n, one, two in zip(tuned.history[0], means[::2], means[1::2], strict=True)
        )
        usual = episodes(adaptation.evaluate(parameters, tasks, key, bounds_of({}, {}, rest=0.0)))
        came = "; ".join(
            f"{n} {usual[n].mean():.4f} → " + ", ".join(f"{figures[n]:.4f}" for figures in seen)
            for n in LOSSES
        )
        print(
            f"{name}: {', '.join(effects) or 'none'}; {notes['seconds']:.0f} s, kept {tuned.update} of {looks}; {learnt}; "
            f"nominal → looks: {came}",
            flush=True,
        )


@functools.cache
def game_of(policy: str):
    """A policy, and its game without family and clamp."""
    loaded = load_policy(policy)
    settings = dataclasses.replace(
        loaded.settings.environment, vehicles=(), rare_vehicles=0.0, speed_limit="none", physics="rigid"
    )
    return loaded, settings


def fly_one(job) -> tuple[str, str, dict[str, list[float]] | None]:
    """Episodes of a policy in the plant with a vehicle: (case, which policy, figures of each episode).

    No figures where it is too late to begin.
    """
    cases, name, which, policy, episodes, latest = job
    if time.time() > latest:
        return name, which, None
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
    names = found_cases(options)
    tuned, own = (
        {} if folder is None else {path.stem: str(path) for path in folder.glob("*.npz")}
        for folder in (options.work, options.own)
    )
    if tuned:
        names = [name for name in names if name in tuned]
    latest = time.time() + options.seconds
    jobs = [
        (options.cases, name, which, policy, options.episodes, latest)
        for name in names
        for which, policy in zip(
            WHICH, (options.policy, options.policy, tuned.get(name), own.get(name)), strict=True
        )
        if policy is not None
    ]
    found: dict[str, dict] = {}
    with multiprocessing.get_context("spawn").Pool(min(options.jobs, len(jobs))) as pool:
        for name, which, figures in pool.imap_unordered(fly_one, jobs):
            if figures is None:
                continue
            found.setdefault(name, {})[which] = figures
            means = {figure: float(np.mean(values)) for figure, values in figures.items()}
            print(name, which, means, f"{time.monotonic() - started:.0f} s", flush=True)
    return {
        "episodes": options.episodes,
        "vehicles": {
            name: found[name] | {"found": load_effects(options.cases / f"{name}.toml")[0]}
            for name in names
            if {NOMINAL, "before", *(["after"] if tuned else [])} <= set(found.get(name, ()))
        },
    }


def losses(vehicles: dict, figure: str, which: str) -> np.ndarray:
    """(V, E) what each episode of a figure costs more than the same episode on the nominal vehicle."""
    sign = -1.0 if figure == "captured" else 1.0
    return sign * np.array(
        [np.subtract(row[which][figure], row[NOMINAL][figure]) for row in vehicles.values()]
    )


def drawn_anew(loss: np.ndarray, draws: int = 2000) -> np.ndarray:
    """(draws,) means of losses (V, E) whose episodes, the same tasks for all vehicles, are drawn anew each time."""
    episodes = np.random.default_rng(0).integers(0, loss.shape[1], (draws, loss.shape[1]))
    return loss.mean(axis=0)[episodes].mean(axis=1)


def losing(loss: np.ndarray, errors: float = 2.0) -> np.ndarray:
    """(V,) which vehicles lose by more than so many standard errors in every other one of their episodes (V, E).

    The others' losses aren't touched by that choice: to choose and to measure by the same episodes would count the return
    to the mean as won.
    """
    half = loss[:, ::2]
    return half.mean(axis=1) > errors * half.std(axis=1) / np.sqrt(half.shape[1])


def share_won(before: np.ndarray, after: np.ndarray, floor: np.ndarray | float = 0.0) -> str:
    """The share of the mean loss above the `floor` that is won back, and its 90 % interval by drawing episodes anew.

    Losses (V, E) before and after, and of the vehicles' own policies, of the same episodes.
    """
    floor = np.broadcast_to(floor, before.shape)
    whole, left = drawn_anew(before - floor), drawn_anew(after - floor)
    low, high = np.nanpercentile(1 - left / np.where(np.abs(whole) > 1e-12, whole, np.nan), [5, 95])
    if np.percentile(whole, 5) <= 0:
        return "–"
    return f"{1 - (after - floor).mean() / (before - floor).mean():.2f} [{low:.2f}, {high:.2f}]"


def report(results: dict) -> list[str]:
    """The page."""
    vehicles = results["vehicles"]
    steps = [step for step in WHICH if all(step in row for row in vehicles.values())]
    lines = [
        "# What adapting wins back",
        "",
        f"{where(results)} {results['seconds']:.0f} s. "
        f"{len(vehicles)} vehicles of the exam's plant with one cause each, {results['episodes']} uniform tasks each, no "
        "clamp, drawn starts. Loss: the difference to the same policy on the plant's nominal vehicle, mean over all vehicles; "
        "intervals of 90 % by drawing episodes anew. " + results.get("note", ""),
        "",
    ]
    if "after" not in steps:
        rows = []
        for figure in FIGURES:
            loss = losses(vehicles, figure, "before")
            low, high = np.percentile(drawn_anew(loss), [5, 95])
            ends = [np.percentile(drawn_anew(one[None]), [5, 95]) for one in loss]
            beyond = sum(bool(one[0] > 0 or one[1] < 0) for one in ends)
            nominal = np.mean([row[NOMINAL][figure] for row in vehicles.values()])
            rows.append(
                [
                    figure,
                    f"{nominal:.4f}",
                    f"{loss.mean():.4f} [{low:.4f}, {high:.4f}]",
                    f"{beyond} of {len(ends)}",
                ]
            )
        heads = [
            "figure",
            "on the nominal vehicle",
            "mean loss",
            "vehicles whose own loss is beyond chance (90 %)",
        ]
        lines += [*table(heads, rows), ""]
    if "after" in steps:
        rows = []
        for figure in FIGURES:
            found = {which: losses(vehicles, figure, which) for which in steps if which != NOMINAL}
            chosen = losing(found["before"])
            cells = [figure, f"{found['before'].mean():.4f}", f"{int(chosen.sum())} of {len(chosen)}"]
            if chosen.any():
                found = {which: loss[chosen, 1::2] for which, loss in found.items()}
                cells += [f"{loss.mean():.4f}" for loss in found.values()]
                floors = [0.0, found["own"]] if "own" in found else [0.0]
                cells += [share_won(found["before"], found["after"], floor) for floor in floors]
            rows.append(cells + [""] * (2 * len(steps) - len(cells)))
        crashes = {
            which: np.array([row[which]["crashed"] for row in vehicles.values()]) > 0
            for which in ("before", "after")
        }
        lines += [
            "Vehicles that lose are chosen by every other episode, and measured by the rest. –: no difference beyond chance."
            + f" Own: trained for that vehicle alone, {LONG} times as long." * ("own" in steps),
            "",
            *table(
                ["figure", "mean loss, all vehicles", "vehicles that lose", "their loss before", "after"]
                + ["own"] * ("own" in steps)
                + ["won back"]
                + ["won back of what the own policy wins"] * ("own" in steps),
                rows,
            ),
            "",
            f"Episodes that crashed after adapting and not before: {int((crashes['after'] & ~crashes['before']).sum())}; "
            f"before and not after: {int((crashes['before'] & ~crashes['after']).sum())}; of {crashes['after'].size}.",
            "",
        ]
    return lines + table(
        ["vehicle", "found", *(f"{figure}: {' → '.join(steps)}" for figure in FIGURES)],
        [
            [
                name,
                ", ".join(row["found"]) or "none",
                *(
                    " → ".join(f"{np.mean(row[step][figure]):.4g}" for step in WHICH if step in row)
                    for figure in FIGURES
                ),
            ]
            for name, row in vehicles.items()
        ],
    )


def main() -> None:
    """Tune, or fly and write the page."""
    parser = page_parser(__doc__, "adapting")
    parser.add_argument("what", choices=("tune", "fly"))
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--work", type=Path, help="where the adapted policies are")
    parser.add_argument("--own", type=Path, help="where the vehicles' own policies are")
    parser.add_argument("--long", action="store_true", help="tune the vehicles' own policies")
    parser.add_argument("--policy", default="flight")
    parser.add_argument("--updates", type=int, default=AdaptSettings.updates)
    parser.add_argument("--learning_rate", type=float, default=AdaptSettings.learning_rate)
    parser.add_argument("--follow", type=float, default=AdaptSettings.follow)
    parser.add_argument("--look_at", type=int, default=1024, help="episodes by which the best step is chosen")
    parser.add_argument("--limit", type=int, default=0, help="vehicles at most; 0: all")
    parser.add_argument("--seconds", type=float, default=1e9, help="begin nothing new after this long")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    if options.what == "tune":
        tune(options)
    else:
        publish(options, study, report)


if __name__ == "__main__":
    main()

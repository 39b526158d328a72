"""The picture of evaders that get away: `python docs/make_escapes.py [--opponent NAME]
[--policy NAME] [--tasks 1024]`.

On uniform tasks with four or five pillars, with the vehicles that the policy was
trained on. Left: the paper's evader on the first task that the opponent survives; then
the first three such tasks. Prints what the evaders do, in captures and in escapes.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from openjax.evaluation.evaluator import Evaluator, layout_slots
from openjax.evaluation.validation import uniform_tasks
from openjax.files import replacing
from openjax.show.plots import EVADER_COLOR, PURSUER_COLORS, draw_from_above
from openjax.show.trajectory import Trajectory
from openjax.store.environments import make_environment
from openjax.store.policies import load_policy

PICTURE = Path(__file__).parent / "pictures" / "escapes.png"
SHOWN = 3
BATCH = 128


def habits(flight: Trajectory) -> dict[str, float]:
    """What the evader does until it is caught, and how fast the pursuers fly."""
    last = max(flight.end(after=0.0), 2)
    evader = flight.evader_position[:last]
    pursuers = flight.pursuer_position[:last]
    velocity = np.diff(evader, axis=0) / flight.time_step
    speeds = np.linalg.norm(np.diff(pursuers, axis=0), axis=-1) / flight.time_step
    return {
        "m from the axis": np.linalg.norm(evader[:, :2], axis=1).mean(),
        "m/s up or down": np.abs(velocity[:, 2]).mean(),
        "m between lowest and highest": np.ptp(evader[:, 2]),
        "share of the time in sight": flight.seen[:last].mean(),
        "m to the nearest pursuer": np.linalg.norm(pursuers - evader[:, None], axis=-1)
        .min(1)
        .mean(),
        "m/s of the pursuers": speeds.mean(),
    }


def draw_heights(axes, flight: Trajectory) -> None:
    """Heights over time."""
    time = flight.time_step * np.arange(len(flight.evader_position))
    for i, color in enumerate(PURSUER_COLORS[: flight.pursuer_position.shape[1]]):
        axes.plot(time, flight.pursuer_position[:, i, 2], color=color, linewidth=0.8)
    axes.plot(time, flight.evader_position[:, 2], color=EVADER_COLOR)
    axes.set(
        xlabel="s",
        ylabel="height [m]",
        xlim=(0, flight.end() * flight.time_step),
        ylim=(0, 1.2),
    )


def draw(path: Path, flights: list[Trajectory]) -> None:
    """A column for each flight: from above, and heights."""
    figure = Figure(figsize=(3.4 * len(flights), 5), layout="constrained")
    panels = figure.subplots(2, len(flights), height_ratios=(3, 1))
    for (above, below), flight in zip(panels.T, flights, strict=True):
        draw_from_above(above, flight)
        draw_heights(below, flight)
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=80)


def main() -> None:
    """Fly, draw and tell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", default="evaders")
    parser.add_argument("--opponent", default="greedy_near")
    parser.add_argument("--tasks", type=int, default=1024)
    parser.add_argument("--out", type=Path, default=PICTURE)
    options = parser.parse_args()
    loaded = load_policy(options.policy)
    slots = layout_slots(loaded.settings.environment)
    game = dataclasses.replace(
        loaded.settings.environment, min_pillars=4, max_pillars=slots
    )
    tasks = uniform_tasks(
        dataclasses.replace(game, max_pillars=5), options.tasks, slots
    )

    def fly(opponent):
        environment = make_environment(game, None, None, opponent)
        own = loaded.in_game(environment)
        evaluator = Evaluator(environment, own.policy, BATCH)
        return evaluator.fly(own.parameters, {opponent: tasks}, jax.random.key(0))[0]

    def tell(flown, name, which):
        all_of = [habits(flown.trajectory(i, "")) for i in which]
        means = ", ".join(
            f"{np.mean([h[k] for h in all_of]):.2f} {k}" for k in all_of[0]
        )
        print(f"{name} ({len(all_of)}): {means}")

    field = fly("field")
    flown = fly(options.opponent)
    caught = np.asarray(flown.evaluation.statistics.captured)
    some = np.flatnonzero(caught)[:BATCH]
    escapes = np.flatnonzero(~caught)
    print(f"{options.opponent}: {caught.mean():.3f} of {options.tasks} captured")
    tell(field, "the paper's evader, on tasks that the other doesn't survive", some)
    tell(flown, f"{options.opponent}, there", some)
    if len(escapes):
        tell(flown, f"{options.opponent}, escapes", escapes)
        seen = [field.trajectory(escapes[0], "the paper's evader")]
        draw(
            options.out,
            [*seen, *(flown.trajectory(i, options.opponent) for i in escapes[:SHOWN])],
        )


if __name__ == "__main__":
    main()

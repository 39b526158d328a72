"""How long evaders are free: `python -m experiments.evaders.survival FILE ...`.

The files are those of `openjax exploit --json` and of `python -m
experiments.evaders.limit --json` for one policy. Stores, of each kind of evaders, the
share of episodes in which the one that is caught least is still free, over time, and
draws the picture of judged.md.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.evaders.judged import JUDGES, PLACES
from experiments.table import facts, page_parser
from openjax.command_line import run_command
from openjax.files import read_json, replacing, write_json
from openjax.pursuit import PursuitSettings

STEPS = PursuitSettings().episode_length
EVERY = 10
"""Control steps between two points of a curve."""


def survival(capture_steps: list[int]) -> list[float]:
    """Share of episodes in which the evader is free after each of the curve's times."""
    steps = np.asarray(capture_steps)[:, None]
    # at its last step, an episode without a capture is told as the game's length
    times = np.minimum(np.arange(0, STEPS + 1, EVERY), STEPS - 1)
    return np.mean(steps > times, axis=0).round(4).tolist()


def curves_of(records: list[dict]) -> list[dict]:
    """One curve for each kind of evaders and of tasks."""
    curves = []
    for kind, belongs in JUDGES.items():
        for place in PLACES:
            own = [r for r in records if r["scenario"] == place and belongs(r["evader"])]
            if own:
                worst = max(own, key=lambda r: np.mean(r["capture_steps"]))
                curves.append(
                    {
                        "evaders": kind,
                        "scenario": place,
                        "strongest": worst["evader"],
                        "episodes": worst["episodes"],
                        "free": survival(worst["capture_steps"]),
                    }
                )
    return curves


def study(options) -> dict:
    """The curves of all files' records."""
    found = [read_json(Path(file)) for file in options.found]
    return {
        "policy": found[0]["policy"],
        "seconds_between": EVERY * PursuitSettings().time_step,
        "curves": curves_of([record for file in found for record in file["records"]]),
    }


def draw(results: Mapping, path: Path) -> None:
    """A panel for each kind of tasks, a line for each kind of evaders."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    panels = figure.subplots(2, 4, sharex=True, sharey=True)
    kinds = list(dict.fromkeys(curve["evaders"] for curve in results["curves"]))
    for axes, place in zip(panels.ravel(), PLACES, strict=False):
        for curve in results["curves"]:
            if curve["scenario"] == place:
                free = curve["free"]
                seconds = results["seconds_between"] * np.arange(len(free))
                color = f"C{kinds.index(curve['evaders'])}"
                axes.plot(seconds, free, color=color, label=curve["evaders"])
        axes.set_title(place, fontsize="medium")
        axes.grid(alpha=0.3)
    for axes in panels[-1]:
        axes.set_xlabel("s")
    for axes in panels[:, 0]:
        axes.set_ylabel("share still free")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    panels[-1, -1].set_axis_off()
    panels[-1, -1].legend(handles, labels, loc="center", frameon=False)
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "survival")
    parser.add_argument("found", nargs="*", metavar="FILE")
    options = parser.parse_args(arguments)
    data = options.out.with_suffix(".json")
    if not options.report:
        write_json(data, {**facts(options.commit), **study(options)})
    draw(read_json(data), options.out.with_suffix(".png"))


if __name__ == "__main__":
    run_command(main)

"""What `judge.sh` found: `python -m experiments.evaders.judge_table DIRECTORY
[DIRECTORY ...]`.

Prints, of each directory's policy, the least capture rates of all judges with the
interval of the least over learners and planner, crashes, and how long the paper's
evader is free, as a multiple of the first directory's.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from experiments.evaders.judged import JUDGES, PLACES, vehicle_of
from openjax.commands.exploit_report import verdict
from openjax.files import read_json
from openjax.pursuit.evaders import HELD_OUT

FILES = ("nominal", "slower")
STEPS = "the paper's, mean steps"
SECOND = "learners and planner"
"""The row that goals are about."""


def rows_of(found: dict, of_each: Callable[[dict], str]) -> Iterator[tuple[str, list[str]]]:
    """Names of judges and a cell for each kind of tasks; what hasn't flown is a
    dash.
    """
    kinds = JUDGES | {
        SECOND: lambda evader: evader.startswith(("learned", "planner")),
        **{name: lambda evader, name=name: evader == name for name in HELD_OUT},
    }
    for judge, belongs in kinds.items():
        records = [own for own in found["records"] if belongs(own["evader"])]
        cells = {own["scenario"]: of_each(own) for own in verdict(records)}
        if records:
            yield judge, [cells.get(place, "-") for place in PLACES]


def rate(own: dict) -> str:
    """A capture rate with its interval."""
    low, high = own["interval"]
    return f"{own['capture_rate']:.2f} ({low:.2f}-{high:.2f})"


def paper_steps(found: dict) -> dict[str, float]:
    """Mean steps of the paper's evader by kinds of tasks."""
    own = [record for record in found["records"] if record["evader"] == "field"]
    return {record["scenario"]: np.mean(record["capture_steps"]) for record in own}


def lines_of(directory: Path, today: dict[str, dict]) -> Iterator[str]:
    """The lines of one directory; `today` are the paper's evader's steps by vehicles,
    to compare with.
    """
    for name in FILES:
        path = directory / f"{name}.json"
        if not path.exists():
            yield f"| {name} | nothing yet |"
            continue
        found = read_json(path)
        vehicle = vehicle_of(found)
        for judge, cells in rows_of(found, rate):
            yield f"| {vehicle}: {judge} | {' | '.join(cells)} |"
        steps = paper_steps(found)
        if steps:
            reference = today.setdefault(vehicle, steps)
            cells = (
                f"{steps[place]:.0f} (x {steps[place] / reference[place]:.2f})"
                if place in steps and place in reference
                else "-"
                for place in PLACES
            )
            yield f"| {vehicle}: {STEPS} | {' | '.join(cells)} |"
            crashes = max(own["crash_rate"] for own in verdict(found["records"]))
            yield f"| {vehicle}: most crashes, any evader and tasks | {crashes:.3f} |"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directories", nargs="+", type=Path)
    today = {}
    for directory in parser.parse_args().directories:
        print(f"\n{directory.name}\n\n| judge | {' | '.join(PLACES)} |")
        print("|" + "---|" * (1 + len(PLACES)))
        for line in lines_of(directory, today):
            print(line)


if __name__ == "__main__":
    main()

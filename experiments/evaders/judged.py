"""Policies before the second judge: `python -m experiments.evaders.judged NAME=FILE ...`.

Each FILE is what `openjax exploit --policy NAME --json FILE` wrote: evaders that learned against
the policy, one that plans in the true simulation, and the scripted ones. None of them trained the
pursuers. Stores the least capture rate of each kind, and makes the table of judged.md.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from experiments.diagnosis.figures import wilson
from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.files import read_json
from openjax.pursuit import SCENARIOS
from openjax.pursuit.evaders import HELD_OUT

PLACES = (*SCENARIOS, "uniform")
JUDGES: Mapping[str, Callable[[str], bool]] = {
    "evaders that learn": lambda evader: evader.startswith("learned"),
    "a planner": lambda evader: evader == "planner",
    "scripted ones, held out": lambda evader: evader in HELD_OUT,
    "the paper's": lambda evader: evader == "field",
}
"""Kinds of evaders, and who belongs to them."""


def row(policy: str, judge: str, records: list[dict]) -> dict:
    """The evader of a kind that is caught least in each kind of tasks, with intervals of 95 %."""
    least, interval, crash = {}, {}, {}
    for place in PLACES:
        here = [record for record in records if record["scenario"] == place]
        worst = min(here, key=lambda record: record["capture_rate"])
        least[place] = worst["capture_rate"]
        captures = round(worst["capture_rate"] * worst["episodes"])
        interval[place] = wilson(captures, worst["episodes"])
        crash[place] = max(record["crash_rate"] for record in here)
    return {
        "policy": policy,
        "judge": judge,
        "evaders": len({record["evader"] for record in records}),
        "capture_rate": least,
        "interval": interval,
        "crash_rate": crash,
    }


def rows_of(policy: str, found: Mapping) -> list[dict]:
    """A row for each judge that flew."""
    rows = []
    for judge, belongs in JUDGES.items():
        records = [record for record in found["records"] if belongs(record["evader"])]
        if records:
            rows.append(row(policy, judge, records))
    return rows


def study(options) -> dict:
    """The rows of all files, after those stored of other policies."""
    data = options.out.with_suffix(".json")
    stored = read_json(data) if data.exists() else {"rows": [], "runs": {}}
    new = dict(item.split("=", 1) for item in options.exploited)
    rows = [old for old in stored["rows"] if old["policy"] not in new]
    runs = {name: run for name, run in stored["runs"].items() if name not in new}
    for policy, file in new.items():
        found = read_json(Path(file))
        rows += rows_of(policy, found)
        runs[policy] = {name: found[name] for name in ("curve", "seconds") if name in found}
    return {"rows": rows, "runs": runs}


def page(results: Mapping) -> Page:
    """One table of least capture rates."""

    def rate(place: str) -> Callable:
        return lambda row: f"{row['capture_rate'][place]:.2f}"

    columns = {
        "policy": "policy",
        "caught least among": "judge",
        **{place: rate(place) for place in PLACES},
        "most crashes": lambda row: f"{max(row['crash_rate'].values()):.2f}",
    }
    return Page("The second judge", "Least capture rates.", Table(columns, results["rows"]))


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "judged")
    parser.add_argument("exploited", nargs="*", metavar="NAME=FILE")
    publish(parser.parse_args(arguments), study, page)


if __name__ == "__main__":
    run_command(main)

"""Policies before the second judge: `python -m experiments.evaders.judged NAME=FILE ...`.

Each FILE is what `openjax exploit --policy NAME --json FILE` wrote: evaders that learned against
the policy, one that plans in the true simulation, and the scripted ones. None of them trained the
pursuers. The slower vehicle is `--effects experiments/flying/slower.toml`. Stores the least capture
rate of each kind, and of the learners over the steps that they have learned; makes table and
picture of judged.md, and writes the figures of README and pages (`experiments.figures`).
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from experiments import figures
from experiments.flying.vehicles import SLOWER
from experiments.table import RESULTS, Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.commands.exploit_report import curve_of, draw_curves, mean_of, verdict
from openjax.files import read_json
from openjax.pursuit import SCENARIOS
from openjax.pursuit.evaders import HELD_OUT
from openjax.vehicle.effects import load_effects
from openjax.vehicle.parameters import NOMINAL

FACTS = ("command", "machine", "seconds")
"""What is another in each run; the rest of what is stored is kept."""
PLACES = (*SCENARIOS, "uniform")
JUDGES: Mapping[str, Callable[[str], bool]] = {
    "evaders that learn": lambda evader: evader.startswith("learned"),
    "a planner": lambda evader: evader.startswith("planner"),
    "splitting, kept apart": lambda evader: evader == "splitting",
    "scripted ones, held out": lambda evader: evader in HELD_OUT,
    "the paper's": lambda evader: evader == "field",
}
"""Kinds of evaders, and who belongs to them."""


def row(policy: str, vehicle: str, judge: str, records: list[dict]) -> dict:
    """The evader of a kind that is caught least in each kind of tasks, with intervals of 95 %."""
    worst = verdict(records)
    fields = ("capture_rate", "interval", "crash_rate")
    return {
        "policy": policy,
        "vehicle": vehicle,
        "judge": judge,
        "evaders": len({record["evader"] for record in records}),
        **{figure: {own["scenario"]: own[figure] for own in worst} for figure in fields},
    }


def vehicle_of(found: Mapping) -> str:
    """Its name in the table."""
    effects = found.get("effects")
    if not effects:
        name = Path(found.get("vehicle", NOMINAL)).stem
        return "nominal" if name == NOMINAL else name
    return "slower" if effects == load_effects(SLOWER)[1] else "with effects"


def rows_of(policy: str, found: Mapping) -> list[dict]:
    """A row for each judge that flew."""
    rows = []
    for judge, belongs in JUDGES.items():
        records = [record for record in found["records"] if belongs(record["evader"])]
        if records:
            rows.append(row(policy, vehicle_of(found), judge, records))
    return rows


def identity(row: Mapping) -> tuple[str, str, str]:
    """What a row is of; a newer one takes its place."""
    return row["policy"], row["vehicle"], row["judge"]


def study(options) -> dict:
    """The rows of all files, after those stored of other policies."""
    data = options.out.with_suffix(".json")
    stored = read_json(data) if data.exists() else {"rows": [], "runs": {}}
    rows, runs, curves = stored["rows"], stored["runs"], stored.get("curves", {})
    for policy, file in (item.split("=", 1) for item in options.exploited):
        found = read_json(Path(file))
        new = rows_of(policy, found)
        again = {identity(own) for own in new}
        rows = [old for old in rows if identity(old) not in again] + new
        name = f"{policy}, {vehicle_of(found)}"
        runs[name] = {name: found[name] for name in ("curve", "seconds") if name in found}
        if found.get("budgets"):
            curves[name] = curve_of(found["budgets"])
    kept = {name: value for name, value in stored.items() if name not in FACTS}
    return {**kept, "rows": rows, "runs": runs, "curves": curves}


TRIED = "tried: "
"""How the names of policies begin that are no weights of the project."""
SHOWN = 500_000_000
"""Steps of each learner whose row is on the page, beside those of the end."""


def page(results: Mapping) -> Page:
    """One table of least capture rates: after learners, and a planner."""
    rows = []
    for name, points in results["curves"].items():
        policy = name.removesuffix(", nominal")
        if policy.startswith(TRIED) or policy == name:
            continue  # other vehicles, and what is told in a line
        near = min(points, key=lambda point: abs(point["steps"] - SHOWN))
        shown = [near] if near is points[-1] else [near, points[-1]]
        rows += [
            {**point, "policy": policy, "judge": f"learners, {point['steps'] / 1e6:.0f} M steps"}
            for point in shown
        ]
        rows += [
            row
            for row in results["rows"]
            if (row["policy"], row["judge"]) == (policy, "a planner")
            and row["vehicle"] == "nominal"
        ]

    def rate(place: str) -> Callable:
        return lambda row: f"{row['capture_rate'][place]:.2f}"

    columns = {
        "policy": "policy",
        "caught least among": "judge",
        **{place: rate(place) for place in PLACES},
        "most crashes": lambda row: f"{max(row['crash_rate'].values()):.2f}",
        "heights, m": lambda row: mean_of(row.get("heights", {}).values()),
    }
    return Page("The second judge", "Least capture rates.", Table(columns, rows))


def draw(results: Mapping, path: Path) -> None:
    """The curves."""
    curves = {
        name.removesuffix(", nominal"): points
        for name, points in results["curves"].items()
        if name.endswith(", nominal")
    }
    draw_curves(path, curves)


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "judged")
    parser.add_argument("exploited", nargs="*", metavar="NAME=FILE")
    options = parser.parse_args(arguments)
    publish(options, study, page, draw)
    if options.out == RESULTS / "judged":
        figures.main([])


if __name__ == "__main__":
    run_command(main)

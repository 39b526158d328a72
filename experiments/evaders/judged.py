"""Policies before the second judge: `python -m experiments.evaders.judged NAME=FILE
...`.

Each FILE is what `openjax exploit --policy NAME --json FILE` wrote: evaders that
learned against the policy, one that plans in the true simulation, and the scripted
ones; or what the programs `limit` and `apart` beside this one wrote. None of them
trained the pursuers. The slower vehicle is `--effects experiments/flying/slower.toml`.
Stores the least capture rate of each kind, makes the table of judged.md, and writes the
rows of weights that ship into README and model cards.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from experiments.flying.vehicles import SLOWER
from experiments.table import RESULTS, Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.files import read_json, write_text
from openjax.pursuit import SCENARIOS
from openjax.pursuit.evaders import HELD_OUT
from openjax.runs.exploit_report import verdict
from openjax.store import DEFAULT_POLICY
from openjax.vehicle.effects import load_effects
from openjax.vehicle.parameters import NOMINAL

FACTS = ("command", "machine", "seconds")
"""What is another in each run; the rest of what is stored is kept."""
PLACES = (*SCENARIOS, "uniform")
SUMMARIES = ("README.md", "docs/model_cards.md")
"""Pages that show the rows of weights that ship ..."""
LIMITS = "both plan"
"""How the names of judges begin that say more of the game than of a policy."""
FOR_ALL = ("evaders that learn", "a planner", "scripted ones, held out", "the paper's")
"""... of these judges, whose episodes are many."""
JUDGES: Mapping[str, Callable[[str], bool]] = {
    "evaders that learn": lambda evader: evader.startswith("learned"),
    "a planner": lambda evader: evader.startswith("planner"),
    "splitting, kept apart": lambda evader: evader == "splitting",
    "both plan, pursuers last": lambda evader: evader == "both plan, pursuers last",
    "both plan, evader last": lambda evader: evader == "both plan, evader last",
    "both plan, pursuers last, as they see": lambda evader: (
        evader == "both plan, pursuers last, honest sight"
    ),
    "both plan, evader last, as they see": lambda evader: (
        evader == "both plan, evader last, honest sight"
    ),
    "both plan, pursuers last, points": lambda evader: evader == "both plan, pursuers last, points",
    "both plan, evader last, points": lambda evader: evader == "both plan, evader last, points",
    "scripted ones, held out": lambda evader: evader in HELD_OUT,
    "the paper's": lambda evader: evader == "field",
}
"""Kinds of evaders, and who belongs to them."""


def row(policy: str, vehicle: str, judge: str, records: list[dict]) -> dict:
    """The evader of a kind that is caught least in each kind of tasks, with intervals
    of 95 %.
    """
    worst = verdict(records)
    figures = ("capture_rate", "interval", "crash_rate")
    return {
        "policy": policy,
        "vehicle": vehicle,
        "judge": judge,
        "evaders": len({record["evader"] for record in records}),
        "shown": policy == DEFAULT_POLICY and vehicle == "nominal" and judge in FOR_ALL,
        **{figure: {own["scenario"]: own[figure] for own in worst} for figure in figures},
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
    rows, runs = stored["rows"], stored["runs"]
    for policy, file in (item.split("=", 1) for item in options.exploited):
        found = read_json(Path(file))
        new = rows_of(policy, found)
        again = {identity(own) for own in new}
        rows = [old for old in rows if identity(old) not in again] + new
        run = {name: found[name] for name in ("curve", "seconds") if name in found}
        runs[f"{policy}, {vehicle_of(found)}"] = run
    kept = {name: value for name, value in stored.items() if name not in FACTS}
    hidden = options.hide if options.hide is not None else stored.get("hidden", [])
    return {**kept, "rows": rows, "runs": runs, "hidden": hidden}


def page(results: Mapping) -> Page:
    """One table of least capture rates."""

    def rate(place: str) -> Callable:
        return lambda row: f"{row['capture_rate'][place]:.2f}"

    columns = {
        "policy": lambda row: (
            row["policy"] + ("" if row["vehicle"] == "nominal" else f", {row['vehicle']} vehicle")
        ),
        "caught least among": "judge",
        **{place: rate(place) for place in PLACES},
        "most crashes": lambda row: f"{max(row['crash_rate'].values()):.2f}",
    }
    rows = [row for row in results["rows"] if is_shown(row, results.get("hidden", []))]
    policies = [row["policy"] for row in rows]
    order = tuple(JUDGES)
    rows.sort(key=lambda row: (policies.index(row["policy"]), order.index(row["judge"])))
    return Page("The second judge", "Least capture rates.", Table(columns, rows))


def is_shown(row: Mapping, hidden: Sequence[str]) -> bool:
    """Whether the table has a row: of weights that don't ship, only what finds most,
    and what the game allows.
    """
    finds_most = row["judge"] in tuple(JUDGES)[:2] or row["judge"].startswith(LIMITS)
    is_hidden = {row["policy"], f"{row['policy']}: {row['judge']}"} & set(hidden)
    return not is_hidden and (finds_most or row["policy"] == DEFAULT_POLICY)


def write_summaries(rows: Sequence[Mapping]) -> None:
    """The rows of weights that ship, and of those before them, on the pages that users
    read.
    """
    heads = ["policy", "caught least among", *PLACES]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    order = tuple(JUDGES)
    policies = [row["policy"] for row in rows]
    for row in sorted(rows, key=lambda r: (policies.index(r["policy"]), order.index(r["judge"]))):
        if row["shown"]:
            rates = (f"{row['capture_rate'][place]:.2f}".removeprefix("0") for place in PLACES)
            lines.append(f"| {row['policy']} | {row['judge']} | {' | '.join(rates)} |")
    for page in SUMMARIES:
        path = RESULTS.parent.parent / page
        before, begin, rest = path.read_text(encoding="utf-8").partition("<!-- judged -->")
        after = rest.partition("<!-- end of judged -->")[2]
        text = "\n".join([before + begin, *lines, "<!-- end of judged -->"])
        write_text(path, text + after)


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "judged")
    parser.add_argument("exploited", nargs="*", metavar="NAME=FILE")
    parser.add_argument("--hide", nargs="*", help="POLICY or 'POLICY: JUDGE': rows that stay out")
    options = parser.parse_args(arguments)
    publish(options, study, page)
    if options.out == RESULTS / "judged":
        write_summaries(read_json(options.out.with_suffix(".json"))["rows"])


if __name__ == "__main__":
    run_command(main)

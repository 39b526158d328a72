"""The page of teams: `python -m experiments.evaders.teams NAME=FILE ...`.

Each FILE is what `openjax map --speed_ratios 1.3 --radii 0.3 --scenario uniform --json FILE` wrote:
one cell for each size of team, by the names of `KINDS`. The table shows what a policy catches,
alone and with what is taken from it. `seed_2_sizes=FILE` and others like it are what single
policies of other trainings catch; `judged=FILE` is what `openjax exploit` found of a policy. Names
that the table doesn't know are kept.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.files import read_json

KINDS = {
    "sizes": "one policy",
    "three": "policy for three",
    "messages": "messages lost, late",
    "fall_outs": "one gone",
    "all_three": "all of these",
}
"""Maps, and their heads in the table."""
SEED = "seed_"
"""How the names of other trainings' maps begin."""


def study(options) -> dict:
    """The maps of all files, after those stored before."""
    data = options.out.with_suffix(".json")
    stored = read_json(data)["maps"] if data.exists() else {}
    files = dict(item.split("=", 1) for item in options.maps)
    return {"maps": stored | {name: read_json(Path(file)) for name, file in files.items()}}


def rows_of(maps: Mapping) -> list[dict]:
    """A row for each size of team; which of them the training had."""
    trained = maps["sizes"]["trained_with"]
    rows = {}
    for kind in KINDS:
        for cell in maps.get(kind, {}).get("cells", []):
            size = cell["num_pursuers"]
            row = rows.setdefault(size, {"size": size, "held_out": size not in trained})
            row[kind] = cell
    for size, rates in seeds_of(maps, "sizes").items():
        rows[size]["seeds"] = f"{min(rates):.3f} to {max(rates):.3f}"
    return [rows[size] for size in sorted(rows)]


def seeds_of(maps: Mapping, kind: str) -> dict[int, list[float]]:
    """Captures of the trainings by other seeds in maps of a kind, by size of team."""
    rates = {}
    for name, content in maps.items():
        if name.startswith(SEED) and name.endswith(f"_{kind}"):
            for cell in content["cells"]:
                rates.setdefault(cell["num_pursuers"], []).append(cell["capture_rate"])
    return rates


def page(results: Mapping) -> Page:
    """One table by size of team."""
    rates = next(iter(seeds_of(results["maps"], "sizes").values()), [])
    number = {2: "two", 3: "three"}.get(len(rates), len(rates))
    columns = {
        "pursuers": lambda row: f"{row['size']}{' (held out)' if row['held_out'] else ''}",
        "one policy": "sizes.capture_rate:.3f",
        f"trained again, {number} seeds": "seeds",
        **{head: f"{kind}.capture_rate:.3f" for kind, head in KINDS.items() if kind != "sizes"},
        "seconds": "sizes.capture_seconds:.2f",
        "crash rate": "sizes.crash_rate:.3f",
    }
    records = Table(columns, rows_of(results["maps"]))
    return Page("One policy for any team", "Shares of episodes with a capture.", records)


def draw(results: Mapping, path: Path) -> None:
    """Captures, with intervals of 95 %, and crashes over the size of the team."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    captures, crashes = figure.subplots(1, 2)
    for (kind, head), marker in zip(KINDS.items(), "os^vD", strict=True):
        cells = results["maps"].get(kind, {}).get("cells", [])
        if not cells:
            continue
        sizes = [cell["num_pursuers"] for cell in cells]
        rates = np.array([cell["capture_rate"] for cell in cells])
        ends = np.array([cell["interval"] for cell in cells]).T
        off = np.abs(ends - rates)
        captures.errorbar(sizes, rates, off, marker=marker, capsize=3, linewidth=1, label=head)
        crashed = [cell["crash_rate"] for cell in cells]
        crashes.plot(sizes, crashed, marker=marker, linewidth=1, label=head)
    captures.set(xlabel="pursuers", ylabel="episodes with a capture")
    crashes.set(xlabel="pursuers", ylabel="episodes with a crash", ylim=(0, None))
    captures.legend(fontsize="small")
    figure.savefig(path, dpi=120)


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "teams")
    parser.add_argument("maps", nargs="*", metavar="NAME=FILE")
    publish(parser.parse_args(arguments), study, page, draw)


if __name__ == "__main__":
    run_command(main)

"""The page of teams: `python -m experiments.evaders.teams NAME=FILE ...`.

Each FILE is what `openjax map --json FILE` wrote. Of maps that hold one cell for each size of team
the table shows what a policy catches, alone and with what is taken from it; the others are drawn.
The names of these maps are those of `KINDS`.
"""

from collections.abc import Mapping
from pathlib import Path

from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.files import read_json
from openjax.show.plots import plot_map

KINDS = {
    "sizes": "one policy",
    "three": "policy for three",
    "messages": "messages lost, late",
    "fall_outs": "one gone",
    "all_three": "all of these",
}
"""Maps of one cell a team, and their heads in the table."""
MAPS = ("empty", "uniform")
"""Maps over speeds and radii."""


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
    return [rows[size] for size in sorted(rows)]


def page(results: Mapping) -> Page:
    """One table by size of team."""
    columns = {
        "pursuers": lambda row: f"{row['size']}{' (held out)' if row['held_out'] else ''}",
        **{head: f"{kind}.capture_rate:.3f" for kind, head in KINDS.items()},
        "seconds": "sizes.capture_seconds:.2f",
        "crash rate": "sizes.crash_rate:.3f",
    }
    records = Table(columns, rows_of(results["maps"]))
    return Page("One policy for any team", "Shares of episodes with a capture.", records)


def draw(results: Mapping, path: Path) -> None:
    """The map over speeds and radii, in the empty arena where there is that one."""
    for name in MAPS:
        if name in results["maps"]:
            found = results["maps"][name]
            plot_map(path, found["cells"], f"captures, {name}; red: forced by a theorem below")
            return


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "teams")
    parser.add_argument("maps", nargs="*", metavar="NAME=FILE")
    publish(parser.parse_args(arguments), study, page, draw)


if __name__ == "__main__":
    run_command(main)

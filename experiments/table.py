"""One manner for all studies: measure, store what was found as JSON, make the page from what is
stored.

    from experiments.table import Page, Table, page_parser, publish

    def study(options) -> dict:  # what is stored, beside command, machine, commit and seconds
        ...

    def page(results) -> Page:  # what is read from there
        columns = {"policy": "name", "capture": "summary.capture_rate:.3f"}
        records = Table(columns, results["records"])
        return Page("Policies on other vehicles", "No clamp, drawn starts.", records)

    publish(page_parser(__doc__, "vehicles").parse_args(arguments), study, page)

`--report` prints the tables of what is stored. A page of results has one of them, between two
marks, in words that somebody wrote: those stay, and the table between the marks is made anew.
"""

import argparse
import math
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openjax.files import read_json, write_json, write_text
from openjax.runs.machine import describe_machine

RESULTS = Path(__file__).parent / "results"
PLACES = ("--out", "--work", "--results", "--flights", "--commit")
"""Options that say where files lie, or what git would say."""
RELEASE = "0.1.0"
"""Of results that don't name theirs."""

MARKS = ("<!-- table -->", "<!-- end of table -->")
"""Between them stands a page's table, which a program makes."""

Column = str | Callable[[Mapping], Any]
"""Of a record: a path through it with a format, `summary.capture_rate:.3f`, or what is computed
from it.
"""


@dataclass(frozen=True)
class Table:
    """Records, one a row, and by the head of each column what it shows of them.

    A list of numbers is shown as mean (standard deviation), a truth as yes or no, and what is
    missing, None or no number as a dash.
    """

    columns: Mapping[str, Column]
    records: Sequence[Mapping]
    title: str = ""
    prose: str = ""

    def lines(self) -> list[str]:
        """The section's Markdown."""
        head = [f"## {self.title}", ""] if self.title else []
        prose = [self.prose, ""] if self.prose else []
        rows = [
            [cell(record, column) for column in self.columns.values()] for record in self.records
        ]
        return [*head, *prose, *table(list(self.columns), rows)]


@dataclass(frozen=True)
class Page:
    """A title, what was done in words, then tables or paragraphs: all that a study prints.

    `table` is the one of at most ten rows that stands on the page of results; by default the first.
    """

    title: str
    prose: str
    parts: Table | str | Sequence[Table | str] = ()
    table: Table | None = None

    def all_parts(self) -> Sequence[Table | str]:
        """Tables and paragraphs in their order."""
        return [self.parts] if isinstance(self.parts, Table | str) else self.parts

    def rows(self) -> list[str]:
        """The Markdown of the one table that stands between the marks of the page of results."""
        columns = self.table or next(part for part in self.all_parts() if isinstance(part, Table))
        return Table(columns.columns, columns.records).lines()

    def lines(self, facts: Mapping) -> list[str]:
        """The report's Markdown, at its end command, commit and machine of `facts`."""
        parts = self.all_parts()
        lines = [f"# {self.title}", "", self.prose]
        for part in parts:
            lines += ["", *(part.lines() if isinstance(part, Table) else [part])]
        return [*lines, "", made(facts)]


def cell(record: Mapping, column: Column) -> str:
    """What a column shows of a record."""
    path, _, digits = column.partition(":") if isinstance(column, str) else ("", "", "")
    value: Any = column(record) if callable(column) else record
    for name in path.split(".") if path else ():
        value = value.get(name) if isinstance(value, Mapping) else None
    if isinstance(value, list | tuple | np.ndarray):
        return spread(list(value), digits)
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return format(value, digits)


def spread(values: Sequence[float | None], digits: int | str) -> str:
    """Mean and, of several, sample standard deviation; None is left out."""
    form = f".{digits}f" if isinstance(digits, int) else digits
    numbers = [value for value in values if value is not None]
    if not numbers:
        return "–"
    deviation = f" ({np.std(numbers, ddof=1):{form}})" if len(numbers) > 1 else ""
    return f"{np.mean(numbers):{form}}{deviation}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]


def made(facts: Mapping) -> str:
    """Command, release, commit and machine of what was stored, as a sentence."""
    machine = facts.get("machine") or {}
    versions = machine.get("versions", {})
    commit = facts.get("commit") or machine.get("commit") or "commit unknown"
    device = f" on {machine['device']}, JAX {versions['jax']}" if machine else ""
    return f"Made with {versions.get('openjax', RELEASE)} ({commit[:14]}) by `{facts['command']}`{device}."


def page_parser(doc: str | None, name: str) -> argparse.ArgumentParser:
    """A parser with `--report`, `--commit` and, by default for the page `name`, `--out`."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--report", action="store_true", help="from the stored results")
    parser.add_argument("--commit", default="", help="where the machine has no repository")
    parser.add_argument("--out", type=Path, default=RESULTS / name)
    return parser


def typed_command() -> str:
    """The command that runs, as one types it, without the places of its work and its results."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).name
    words = iter(sys.argv[1:])
    kept = []
    for word in words:
        if word in PLACES:
            next(words, None)
        elif word.partition("=")[0] not in PLACES:
            kept.append(word)
    return shlex.join(["python", "-m", name, *kept])


def facts(commit: str | None = None) -> dict:
    """What stands beside all results: the command, the machine, and the commit, where the source
    tree can't tell.
    """
    machine = describe_machine()
    return {"command": typed_command(), "machine": machine | ({"commit": commit} if commit else {})}


def publish(
    options: argparse.Namespace,
    study: Callable[[argparse.Namespace], Mapping],
    page: Callable[[Any], Page],
    draw: Callable[[Any, Path], None] | None = None,
) -> None:
    """Store what `study` finds (unless told to read it), print the report made from what is stored,
    and write its page.

    Command, machine and seconds stand beside it; `draw` draws the page's figure.
    """
    data = options.out.with_suffix(".json")
    if not options.report:
        start = time.monotonic()
        results = study(options)
        write_json(data, {**facts(options.commit), "seconds": time.monotonic() - start, **results})
    write_page(options.out, page, read_json(data), draw)


def write_page(
    out: Path,
    page: Callable[[Any], Page],
    results: Any,
    draw: Callable[[Any, Path], None] | None = None,
) -> None:
    """Print the report of `results`, write its page, and draw its figure if there is one.

    A page whose table stands between the marks keeps its words; any other becomes the report.
    """
    content = page(results)
    report = "\n".join(content.lines(results)) + "\n"
    path = out.with_suffix(".md")
    old_text = path.read_text(encoding="utf-8") if path.exists() else ""
    write_text(path, with_table(old_text, content) if MARKS[0] in old_text else report)
    if draw is not None:
        draw(results, out.with_suffix(".png"))
    print(report, end="")


def with_table(text: str, page: Page) -> str:
    """A page's text, with the table between the marks as `page` has it."""
    begin, end = MARKS
    head, _, rest = text.partition(begin)
    tail = rest.partition(end)[2]
    return "\n".join([head + begin, *page.rows(), end + tail])

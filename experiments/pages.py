"""What the scripts that make a page have in common: measure or read what was stored, write both files and a figure."""

import argparse
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from openjax.commands.machine import describe_machine
from openjax.files import read_json
from openjax.store.settings_files import write_json

RESULTS = Path(__file__).parent / "results"
PLACES = ("--out", "--work", "--results", "--commit")
"""Options that say where files lie, or what git would say."""


def page_parser(doc: str, name: str) -> argparse.ArgumentParser:
    """A parser with `--report`, `--commit` and, by default for the page `name`, `--out`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", action="store_true", help="from the stored results")
    parser.add_argument("--commit", default="", help="where the machine has no repository")
    parser.add_argument("--out", type=Path, default=RESULTS / name)
    return parser


def typed_command() -> str:
    """The command that runs, as one types it, without the places of its work and its results."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).name
    words, kept = iter(sys.argv[1:]), []
    for word in words:
        if word in PLACES:
            next(words, None)
        elif word.partition("=")[0] not in PLACES:
            kept.append(word)
    return shlex.join(["python", "-m", name, *kept])


def facts(commit: str | None = None) -> dict:
    """What stands beside all results: the command, the machine, and the commit, where the source tree can't tell."""
    machine = describe_machine()
    return {"command": typed_command(), "machine": machine | ({"commit": commit} if commit else {})}


def publish(
    options: argparse.Namespace,
    study: Callable[[argparse.Namespace], Any],
    report: Callable[[Any], list[str]],
    draw: Callable[[Any, Path], None] | None = None,
) -> None:
    """Store what `study` finds (unless told to read it), then write and print the page made from what is stored.

    Command, machine and seconds stand beside it.
    """
    data = options.out.with_suffix(".json")
    if not options.report:
        started = time.monotonic()
        found = study(options)
        write_json(data, {**facts(options.commit), "seconds": time.monotonic() - started, **found})
    results = read_json(data)
    write_page(options.out, report(results), results, draw)


def write_page(
    out: Path, lines: list[str], results: Any = None, draw: Callable[[Any, Path], None] | None = None
) -> None:
    """Write and print the page, and draw its figure of `results` if there is one."""
    out.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if draw is not None:
        draw(results, out.with_suffix(".png"))
    print("\n".join(lines))


def where(results: dict) -> str:
    """Command, machine and commit of what was stored, as a sentence."""
    machine = results["machine"]
    commit = results.get("commit") or machine.get("commit") or "unknown"
    return (
        f"`{results['command']}` on {machine['device']}, JAX {machine['versions']['jax']}, commit {commit}."
    )


def page_from_tables(
    doc: str,
    name: str,
    report: Callable[[Any], list[str]],
    arguments: list[str],
    draw: Callable[[Any, Path], None] | None = None,
) -> int:
    """Write and print the page `name` (and its figure) from what tables.py stored."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=Path, default=RESULTS / "tables.json", help="what tables.py stored")
    parser.add_argument("--out", type=Path, default=RESULTS / name)
    options = parser.parse_args(arguments)
    results = read_json(options.flights)
    write_page(options.out, report(results), results, draw)
    return 0


def table(heads: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]


def spread(values: list[float | None], digits: int) -> str:
    """Mean and, of several, sample standard deviation; None is left out."""
    values = [value for value in values if value is not None]
    if not values:
        return "–"
    deviation = f" ({np.std(values, ddof=1):.{digits}f})" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{deviation}"

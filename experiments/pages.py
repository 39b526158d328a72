"""Pages as lists of lines: what the studies that don't use `experiments.table` yet share."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.table import RESULTS, facts, page_parser, spread, table, typed_command
from openjax.files import read_json
from openjax.store.settings_files import write_json

__all__ = [
    "RESULTS",
    "facts",
    "page_from_tables",
    "page_parser",
    "publish",
    "spread",
    "table",
    "typed_command",
    "where",
    "write_page",
]


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

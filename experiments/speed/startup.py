"""Seconds to a training run's first update: `python -m experiments.speed.startup [--preset paper] [--repeats 2]`.

Once with an empty and some times with a filled cache of compiled programs. Writes experiments/results/startup.json, .md.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.errors import UserError
from openjax.show.metrics import METRICS_FILE, read_metrics


def start_once(options: argparse.Namespace, scratch: Path, name: str) -> dict:
    """Seconds after which each phase was announced and the first update was done, and the processor's until then.

    Raises:
      UserError: it wasn't done within the limit.
    """
    run, phases = scratch / name, {}
    environment = {**os.environ, "XDG_CACHE_HOME": str(scratch / "cache"), "PYTHONUNBUFFERED": "1"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-m", "openjax.train", "--preset", options.preset, "--out", str(run)]
    started = time.monotonic()
    process = subprocess.Popen(
        [*command, *options.options.split()], env=environment, stdout=subprocess.PIPE, text=True
    )
    watch = threading.Timer(options.limit, process.kill)
    watch.start()
    for line in process.stdout:
        if "steps/s" in line:
            break
        if line.rstrip().endswith("..."):
            phase = line.removeprefix("openjax.train: ").rstrip(" .\n").partition(":")[0]
            phases.setdefault(phase, round(time.monotonic() - started, 1))
    process.kill()
    watch.cancel()
    _, _, usage = os.wait4(process.pid, 0)
    records = list(read_metrics(run / METRICS_FILE, "train")) if (run / METRICS_FILE).exists() else []
    if not records:
        raise UserError(f"no update within {options.limit:.0f} s; phases so far: {', '.join(phases)}")
    return {
        "cache": name,
        "phases": phases,
        "first_update": records[0]["seconds"],
        "processor": round(usage.ru_utime + usage.ru_stime, 1),
    }


def study(options: argparse.Namespace) -> dict:
    """All starts."""
    with tempfile.TemporaryDirectory() as folder:
        names = ["cold", *(f"warm_{i + 1}" for i in range(options.repeats))]
        starts = [start_once(options, Path(folder), name) for name in names]
    return {"preset": options.preset, "starts": starts}


def page(results: dict) -> Page:
    """A row per start, and one per program where somebody compiled them alone."""
    phases = dict.fromkeys(name for start in results["starts"] for name in start.get("phases", ()))
    columns = {"cache": "cache"} | {f"{phase}, from s": f"phases.{phase}" for phase in phases}
    columns |= {"first update done, s": "first_update:.1f", "of processor, s": "processor:.0f"}
    prose = f"Preset `{results['preset']}` on {results['machine']['cpu_cores']} CPU cores."
    tables = [Table(columns, results["starts"])]
    if "programs" in results:
        columns = {"program": "program", "compiled, s": "seconds:.1f", "of processor, s": "processor:.1f"}
        tables.append(Table(columns, results["programs"], "What the compiler takes", results["note"]))
    return Page("Seconds to the first update", results.get("prose", prose), tables)


def main(arguments: list[str]) -> int:
    """Time the starts, write both files."""
    parser = page_parser(__doc__, "startup")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--options", default="", help="more options of openjax.train")
    parser.add_argument("--repeats", type=int, default=2, help="starts with a filled cache")
    parser.add_argument(
        "--limit", type=float, default=300.0, help="longest time to wait for a first update, s"
    )
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

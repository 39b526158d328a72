"""Seconds from the command to a training run's first update, with an empty and with a filled cache of compiled programs.

python -m experiments.startup [--preset paper] [--repeats 2] [--out experiments/results/startup]
"""

import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import tyro

from experiments.pages import facts, table
from openjax.show.metrics import METRICS_FILE, read_metrics
from openjax.store.settings_files import write_json

PHASES = ("loading", "compiling the start", "compiling the training step", "training")


@dataclasses.dataclass(frozen=True)
class StartupCommand:
    """Time the start of training."""

    preset: str = "paper"
    options: str = ""
    """More options of openjax.train."""
    repeats: int = 2
    """Starts with a filled cache."""
    limit: float = 300.0
    """Longest time to wait for a first update, s."""
    out: Path = Path(__file__).parent / "results" / "startup"
    """Results are written to this path with .json and .md."""


def start_once(command: StartupCommand, scratch: Path, name: str) -> dict:
    """Seconds after which each phase was announced and the first update was done, and the processor's until then.

    Raises SystemExit where it wasn't done within the limit.
    """
    run, seconds = scratch / name, {}
    environment = {**os.environ, "XDG_CACHE_HOME": str(scratch / "cache"), "PYTHONUNBUFFERED": "1"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    arguments = [sys.executable, "-m", "openjax.train", "--preset", command.preset, "--out", str(run)]
    started = time.monotonic()
    process = subprocess.Popen(
        [*arguments, *command.options.split()], env=environment, stdout=subprocess.PIPE, text=True
    )
    watch = threading.Timer(command.limit, process.kill)
    watch.start()
    for line in process.stdout:
        said = line.removeprefix("openjax.train: ")
        for phase in PHASES:
            if said.startswith(phase):
                seconds.setdefault(phase, round(time.monotonic() - started, 1))
        if "steps/s" in line:
            break
    process.kill()
    watch.cancel()
    _, _, usage = os.wait4(process.pid, 0)
    records = list(read_metrics(run / METRICS_FILE, "train")) if (run / METRICS_FILE).exists() else []
    if not records:
        raise SystemExit(f"no update within {command.limit:.0f} s; the last phase was {list(seconds)[-1:]}")
    return {
        "cache": name,
        "phases": seconds,
        "first_update": records[0]["seconds"],
        "processor": round(usage.ru_utime + usage.ru_stime, 1),
    }


def main(command: StartupCommand) -> dict:
    """All starts; returns what is written."""
    results: dict = facts()
    with tempfile.TemporaryDirectory() as folder:
        names = ["cold", *(f"warm {i + 1}" for i in range(command.repeats))]
        results["starts"] = [start_once(command, Path(folder), name.replace(" ", "_")) for name in names]
        cache = [path.stat().st_size for path in Path(folder, "cache").rglob("*") if path.is_file()]
        results["cache_megabytes"] = round(sum(cache) / 2**20, 1)
    write_json(command.out.with_suffix(".json"), results)
    command.out.with_suffix(".md").write_text(page(results, command))
    return results


def page(results: dict, command: StartupCommand) -> str:
    """The results as Markdown."""
    machine = results["machine"]
    warm = statistics.median(start["first_update"] for start in results["starts"][1:])
    cold_goal, warm_goal = (" (goal 45)", " (goal 15)") if machine["platform"] == "gpu" else ("", "")
    heads = [
        "cache",
        *(f"{phase}, from s" for phase in PHASES[1:]),
        "first update done, s",
        "of processor, s",
    ]
    rows = [
        [
            start["cache"].replace("_", " "),
            *(str(start["phases"].get(phase, "")) for phase in PHASES[1:]),
            f"{start['first_update']:.1f}",
            f"{start['processor']:.0f}",
        ]
        for start in results["starts"]
    ]
    lines = [
        "# Seconds to the first update",
        "",
        f"`{results['command']}`, preset `{command.preset}`, commit {machine['commit']}, {machine['device']}, "
        f"{machine['cpu_cores']} CPU cores, JAX {machine['versions']['jax']}, {machine['date']}. The cache of compiled "
        f"programs holds {results['cache_megabytes']} MB then.",
        "",
        f"Cold: {results['starts'][0]['first_update']:.0f} s{cold_goal}. Warm: {warm:.0f} s{warm_goal}.",
        "",
        *table(heads, rows),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(StartupCommand))

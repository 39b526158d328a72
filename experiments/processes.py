"""Two processes with one GPU each against one process with both and one GPU alone: speed, the loss of one, going on alone.

    python -m experiments.processes [--preset paper] [--seconds 15] [--out experiments/results/processes]

Two GPUs fly twice the preset's worlds. First all programs are compiled into a cache, side by side, which the two
processes do until their first checkpoint; then one of them is killed, both kinds of two are timed, one after the other,
and the lost run is gone on with on one GPU beside one GPU alone. With `--apart_only` nothing but the two processes;
the rest stays as an earlier call left it. Needs two devices; with `--cpu` they are two virtual ones, to try the script.
"""

import dataclasses
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import tyro

from experiments.pages import table, typed_command, where
from openjax.files import read_json
from openjax.show.metrics import METRICS_FILE, read_metrics
from openjax.store.settings_files import write_json


@dataclasses.dataclass(frozen=True)
class ProcessesCommand:
    """Train on two devices of one host, by one process and by two."""

    preset: str = "paper"
    num_envs: int = 5120
    """Worlds per device."""
    options: str = ""
    """More options of openjax.train."""
    seconds: float = 15.0
    """Time each is measured for, after its first update."""
    compilation: float = 240.0
    """Longest time to wait for a first update."""
    apart_only: bool = False
    """Time the two processes alone."""
    cpu: bool = False
    """Two virtual CPU devices instead of GPUs."""
    out: Path = Path(__file__).parent / "results" / "processes"
    """Results are written to this path with .json and .md."""


class Job:
    """A training run of one process or of two."""

    def __init__(
        self, command: ProcessesCommand, scratch: Path, name: str, devices: list[list[str]], *options: str
    ):
        self.run, self.processes, self.texts = scratch / name, [], []
        port = _free_port()
        for index, own in enumerate(devices):
            environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(scratch / "cache")}
            environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
            if command.cpu:
                environment |= {"JAX_PLATFORMS": "cpu"}
                flags = os.environ.get("XLA_FLAGS", "")
                environment["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={len(own)}"
            else:
                environment["CUDA_VISIBLE_DEVICES"] = ",".join(own)
            arguments = [sys.executable, "-m", "openjax.train", *options]
            if "--resume" not in options:
                arguments += ["--preset", command.preset, "--out", str(self.run), *command.options.split()]
            arguments += ["--devices", "all"]
            if len(devices) > 1:
                arguments += [
                    "--coordinator_address",
                    f"127.0.0.1:{port}",
                    "--num_processes",
                    str(len(devices)),
                ]
                arguments += ["--process_id", str(index)]
            self.texts.append(scratch / f"{name}_{index}_{time.monotonic_ns()}.txt")
            with open(self.texts[-1], "w") as text:
                self.processes.append(
                    subprocess.Popen(arguments, env=environment, stdout=text, stderr=subprocess.STDOUT)
                )

    def updates(self, after: int = 0) -> list[dict]:
        """The training records so far, of updates after one."""
        file = self.run / METRICS_FILE
        records = list(read_metrics(file, "train")) if file.exists() else []
        return [record for record in records if record["update"] > after]

    def wait_for(self, seconds: float, happened) -> None:
        """Wait until something happened. Raises RuntimeError where a process ends before or time runs out."""
        deadline = time.monotonic() + seconds
        while not happened():
            if any(process.poll() is not None for process in self.processes) or time.monotonic() > deadline:
                said = "\n".join(text.read_text()[-1500:] for text in self.texts)
                self.end(signal.SIGKILL)
                raise RuntimeError(f"{self.run.name} ended or took too long:\n{said}")
            time.sleep(0.1)

    def end(self, number: int) -> list[int]:
        """Send a signal to all processes; their exit statuses."""
        for process in self.processes:
            process.send_signal(number)
        return [process.wait(120) for process in self.processes]


def speed(records: list[dict]) -> int:
    """Environment steps per second, without the first quarter."""
    first, last = records[len(records) // 4], records[-1]
    return round((last["steps"] - first["steps"]) / (last["seconds"] - first["seconds"]))


def timed(command: ProcessesCommand, job: Job) -> dict:
    """Wait for a job's first update, time those that follow, and end it."""
    job.wait_for(command.compilation, job.updates)
    first = job.updates()[0]["seconds"]
    time.sleep(command.seconds)
    statuses = job.end(signal.SIGTERM)
    records = job.updates()
    return {
        "first_update_seconds": first,
        "updates": len(records),
        "env_steps_per_second": speed(records),
        "statuses": statuses,
        "last_reward": records[-1]["reward"],
    }


def lose_one(job: Job) -> dict:
    """Kill the second process; how the first one ends."""
    job.processes[1].kill()
    started = time.monotonic()
    status = job.processes[0].wait(120)
    text = job.texts[0].read_text().replace(str(job.run), "RUN")
    return {
        "status": status,
        "seconds": round(time.monotonic() - started, 1),
        "said": [line for line in text.splitlines() if line.startswith("error")][-1:],
        "trace": "Traceback" in text,
    }


def go_on(command: ProcessesCommand, job: Job) -> dict:
    """Time a resumed run, and end it."""

    def restored():
        found = re.search(r"resumed at update (\d+)", job.texts[0].read_text())
        return found and len(job.updates(int(found[1]))) > 4 and int(found[1])

    job.wait_for(command.compilation, restored)
    at = restored()
    time.sleep(command.seconds)
    statuses = job.end(signal.SIGTERM)
    records = job.updates(at)
    return {
        "at_update": at,
        "updates": len(records),
        "env_steps_per_second": speed(records),
        "statuses": statuses,
    }


def main(command: ProcessesCommand) -> dict:
    """All measurements; returns what is written."""
    gpus = (os.environ.get("CUDA_VISIBLE_DEVICES") or "0,1").split(",")[:2]
    together, apart, alone, other = [gpus], [[gpus[0]], [gpus[1]]], [gpus[:1]], [gpus[1:]]
    twice = ("--num_envs", str(2 * command.num_envs))
    unwatched = ("--validation_interval", "100000")
    data = command.out.with_suffix(".json")
    results: dict = read_json(data) if command.apart_only and data.exists() else {}
    results["apart_command" if command.apart_only else "command"] = typed_command()

    def tell(name, found):
        results[name] = found
        print(name, found, flush=True)
        write_json(data, results)

    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        started = time.monotonic()
        lost = Job(command, scratch, "lost", apart, *twice, "--validation_interval", "10")
        compiling = []
        if not command.apart_only:
            compiling = [
                Job(command, scratch, "compiling_together", together, *twice, *unwatched),
                Job(
                    command,
                    scratch,
                    "compiling_alone",
                    alone,
                    *unwatched,
                    "--num_envs",
                    str(command.num_envs),
                ),
                Job(command, scratch, "compiling_resumed", other, *twice, *unwatched),
            ]
        for job in compiling:
            job.wait_for(command.compilation, job.updates)
            job.end(signal.SIGKILL)
        lost.wait_for(command.compilation, lambda: list((lost.run / "checkpoints").glob("*.sha256")))
        tell("compilation_seconds", round(time.monotonic() - started))
        tell("process 1 killed", lose_one(lost))

        os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "true"
        two = Job(command, scratch, "two_processes", apart, *twice, *unwatched)
        tell("two processes", timed(command, two))
        machine = json.loads((two.run / "settings.json").read_text(encoding="utf-8"))["machine"]
        tell("apart_machine" if command.apart_only else "machine", machine)
        if not command.apart_only:
            tell(
                "one process",
                timed(command, Job(command, scratch, "one_process", together, *twice, *unwatched)),
            )
            one = Job(command, scratch, "one_device", alone, *unwatched, "--num_envs", str(command.num_envs))
            resumed = Job(command, scratch, "lost", other, "--resume", str(lost.run))
            with ThreadPoolExecutor(2) as beside:
                futures = beside.submit(timed, command, one), beside.submit(go_on, command, resumed)
                tell("one device", futures[0].result())
                tell("resumed on one device", futures[1].result())
    command.out.with_suffix(".md").write_text(page(results, command))
    return results


def page(results: dict, command: ProcessesCommand) -> str:
    """The results as Markdown."""
    machine = results["machine"]
    lost, resumed = results["process 1 killed"], results["resumed on one device"]
    alone = results["one device"]["env_steps_per_second"]
    rows = [
        [
            name,
            f"{worlds * command.num_envs:,}",
            f"{row['first_update_seconds']:.0f}",
            f"{speed:,}",
            f"{speed / alone:.2f}",
        ]
        for name, worlds in (("one device", 1), ("one process", 2), ("two processes", 2))
        if name in results
        for row in [results[name]]
        for speed in [row["env_steps_per_second"]]
    ]
    heads = [
        "training",
        "worlds",
        "first update, s",
        "environment steps/s, without validations",
        "against one device",
    ]
    lines = [
        "# Two processes",
        "",
        f"{where(results)} {machine['cpu_cores']} CPU cores, {machine['date']}. Preset `{command.preset}`, programs compiled "
        f"before, side by side, in {results['compilation_seconds']} s.",
        *(
            [f"The two processes: `{results['apart_command']}`, commit {results['apart_machine']['commit']}."]
            if "apart_command" in results
            else []
        ),
        "",
        *table(heads, rows),
        "",
        f"Process 1 killed (SIGKILL) after a checkpoint: process 0 ended {lost['seconds']} s later with status "
        f"{lost['status']}, {'a' if lost['trace'] else 'no'} stack trace, and the line",
        "",
        *(f"    {line}" for line in lost["said"]),
        "",
        f"Resumed on one device at update {resumed['at_update']}, with all worlds: "
        f"{resumed['env_steps_per_second']:,} environment steps/s.",
    ]
    return "\n".join(lines) + "\n"


def _free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


if __name__ == "__main__":
    main(tyro.cli(ProcessesCommand))

"""Two processes with one GPU each against one process with both: speed, the loss of one, and going on with one GPU.

    python -m experiments.processes [--preset paper] [--seconds 25] [--out experiments/results/processes]

First all three programs (two devices of one process, two processes, one device) are compiled into a cache, side by
side; then each is timed alone. Needs two devices; with `--cpu` they are two virtual ones, to try the script.
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
from pathlib import Path

import tyro

from openjax.show.metrics import METRICS_FILE, read_metrics
from openjax.store.settings_files import write_json


@dataclasses.dataclass(frozen=True)
class ProcessesCommand:
    """Train on two devices of one host, by one process and by two."""

    preset: str = "paper"
    options: str = ""
    """More options of openjax.train."""
    seconds: float = 25.0
    """Time each is measured for, after its first update."""
    compilation: float = 240.0
    """Longest time to wait for a first update."""
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
                environment["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={len(own)}"
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


def main(command: ProcessesCommand) -> dict:
    """All measurements; returns what is written."""
    gpus = (os.environ.get("CUDA_VISIBLE_DEVICES") or "0,1").split(",")[:2]
    together, apart = [gpus], [[gpus[0]], [gpus[1]]]
    results: dict = {"command": "python -m experiments.processes " + " ".join(sys.argv[1:])}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        started = time.monotonic()
        jobs = [
            Job(command, scratch, f"compiling_{i}", d) for i, d in enumerate((together, apart, [gpus[:1]]))
        ]
        for job in jobs:
            job.wait_for(command.compilation, lambda job=job: job.updates())
        for job in jobs:
            job.end(signal.SIGKILL)
        results["compilation_seconds"] = round(time.monotonic() - started)
        print(f"compiled in {results['compilation_seconds']} s", flush=True)
        os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "true"
        for name, devices in (("one process", together), ("two processes", apart)):
            job = Job(command, scratch, name.replace(" ", "_"), devices, "--validation_interval", "100000")
            job.wait_for(command.compilation, job.updates)
            first = job.updates()[0]["seconds"]
            time.sleep(command.seconds)
            statuses = job.end(signal.SIGTERM)
            records = job.updates()
            results[name] = {
                "first_update_seconds": first, "updates": len(records), "env_steps_per_second": speed(records),
                "statuses": statuses, "last_reward": records[-1]["reward"],
            }  # fmt: skip
            settings = json.loads((job.run / "settings.json").read_text(encoding="utf-8"))
            results["machine"] = settings["machine"]
            print(name, results[name], flush=True)

        job = Job(command, scratch, "lost", apart, "--validation_interval", "10")
        job.wait_for(command.compilation, lambda: list((job.run / "checkpoints").glob("*.sha256")))
        job.processes[1].kill()
        started = time.monotonic()
        status = job.processes[0].wait(120)
        said = [line for line in job.texts[0].read_text().splitlines() if line.startswith("error")]
        results["process 1 killed"] = {
            "status": status, "seconds": round(time.monotonic() - started, 1), "said": said[-1:],
            "trace": "Traceback" in job.texts[0].read_text(),
        }  # fmt: skip
        print(results["process 1 killed"], flush=True)

        resumed = Job(command, scratch, "lost", [gpus[:1]], "--resume", str(job.run))

        def restored():
            found = re.search(r"resumed at update (\d+)", resumed.texts[0].read_text())
            return found and resumed.updates(int(found[1])) and int(found[1])

        resumed.wait_for(command.compilation, restored)
        at = restored()
        time.sleep(command.seconds / 2)
        statuses = resumed.end(signal.SIGTERM)
        records = resumed.updates(at)
        results["resumed on one GPU"] = {
            "at_update": at, "updates": len(records), "env_steps_per_second": speed(records), "statuses": statuses,
        }  # fmt: skip
        print(results["resumed on one GPU"], flush=True)
    write_json(command.out.with_suffix(".json"), results)
    command.out.with_suffix(".md").write_text(page(results, command))
    return results


def page(results: dict, command: ProcessesCommand) -> str:
    """The results as Markdown."""
    machine = results["machine"]
    lost, resumed = results["process 1 killed"], results["resumed on one GPU"]
    lines = [
        "# Two processes",
        "",
        f"`{results['command']}`, commit {machine['commit']}, {machine['device']}, {machine['cpu_cores']} CPU cores, JAX "
        f"{machine['versions']['jax']}, {machine['date']}. Preset `{command.preset}`, programs compiled before.",
        "",
        "| training on two devices | first update, s | environment steps/s, without validations |",
        "|---|---|---|",
    ]
    for name in ("one process", "two processes"):
        row = results[name]
        lines.append(f"| {name} | {row['first_update_seconds']:.0f} | {row['env_steps_per_second']:,} |")
    lines += [
        "",
        f"Process 1 killed (SIGKILL) after a checkpoint: process 0 ended {lost['seconds']} s later with status "
        f"{lost['status']} and the line",
        "",
        *(f"    {line}" for line in lost["said"]),
        "",
        f"Resumed on one device at update {resumed['at_update']}: {resumed['env_steps_per_second']:,} environment steps/s.",
    ]
    return "\n".join(lines) + "\n"


def _free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


if __name__ == "__main__":
    main(tyro.cli(ProcessesCommand))

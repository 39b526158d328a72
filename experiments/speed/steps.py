"""Where a training step's time goes: `python -m experiments.speed.steps --cases paper:5120 paper:20480:formulas [--raw FOLDER]`.

A case is a preset, its worlds, and what is done otherwise than usual; `@FOLDER` after it names another tree of sources. Each is
compiled in a process of its own, all side by side; then, one after the other, steps are timed and one is profiled. A phase
(`openjax.learning.training_step.Phases`) takes the sum of its kernels. Writes experiments/results/steps.json and .md.
"""

import argparse
import collections
import dataclasses
import gzip
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command

PHASES = ("fly", "learn_predictor", "learn_evaders", "learn_policy", "renew")
OTHERWISE = {
    "": "",
    "formulas": "attention and normalisation by their formulas",
    "attention": "attention by its formula",
    "normalisation": "normalisation by its formula",
    "body": "the body's step by its formula",
    "cublas": "matrix products by cuBLAS alone",
    "fusions": "fusions untried",
    "cublas_fusions": "matrix products by cuBLAS alone, fusions untried",
    "level_1": "trials unchecked",
    "untuned": "nothing tried",
    "shared": "one encoder",
    "graphs": "loops as CUDA graphs",
}
COMPILER = {
    "cublas": {"xla_gpu_enable_triton_gemm": False},
    "fusions": {"xla_gpu_experimental_enable_fusion_autotuner": False},
    "cublas_fusions": {
        "xla_gpu_enable_triton_gemm": False,
        "xla_gpu_experimental_enable_fusion_autotuner": False,
    },
    "level_1": {"xla_gpu_autotune_level": 1},
    "untuned": {"xla_gpu_autotune_level": 0},
}
GRAPHS = "--xla_gpu_enable_command_buffer=FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,WHILE,CONDITIONAL"
SECONDS = 0.6
"""Of timed steps in each case."""


def measure(case: str, raw: Path | None) -> dict:
    """Compile a case, wait for a line on the standard input, time and profile it."""
    if case.endswith(":graphs"):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {GRAPHS}"
    import jax

    from openjax.commands.training_loop import guarded
    from openjax.learning import init_carry, make_training_step, preset
    from openjax.store.leaves import abstract_like

    name, worlds, otherwise = [*case.split(":"), ""][:3]
    settings = dataclasses.replace(preset(name), num_envs=int(worlds))
    if otherwise == "shared":
        network = dataclasses.replace(settings.network, shared_encoder=True)
        settings = dataclasses.replace(settings, network=network)
    _without_kernels(otherwise)
    began = time.monotonic()
    carry = init_carry(settings, jax.random.key(0))
    lowered = guarded(make_training_step(settings)).lower(abstract_like(carry))
    traced, used_by_trace = time.monotonic(), _processor_seconds()
    on_gpu = jax.default_backend() == "gpu"
    # a core's share of a laptop's worlds, by one thread, as it is trained
    step = lowered.compile(COMPILER.get(otherwise, {}) if on_gpu else {"xla_cpu_multi_thread_eigen": False})
    record = {
        "case": case,
        "preset": name,
        "worlds": int(worlds),
        "otherwise": otherwise,
        "trace_seconds": traced - began,
        "compile_seconds": time.monotonic() - traced,
        "compile_processor_seconds": _processor_seconds() - used_by_trace,
        "instructions_before": lowered.as_text().count(" = "),
        **_counted(step.as_text()),
    }
    print("ready", flush=True)
    sys.stdin.readline()
    carry = jax.block_until_ready(step(carry))[0]
    times = []
    while sum(times) < SECONDS or len(times) < 3:
        start = time.perf_counter()
        carry = jax.block_until_ready(step(carry))[0]
        times.append(time.perf_counter() - start)
    median = float(np.median(times))
    record |= {"ms": 1e3 * median, "fastest_ms": 1e3 * min(times), "calls": len(times)}
    record["steps_per_second"] = settings.steps_per_update / median
    events = _profiled(step, carry)
    print("timed", flush=True)
    return record | _by_phase(events, step.as_text(), case, raw)


def _without_kernels(otherwise):
    """Have formulas in place of some kernels."""
    import openjax.kernels.attention
    import openjax.kernels.normalisation
    import openjax.vehicle.rigid_kernel

    def formula(reference, kernel, *static):
        return lambda *arrays: reference(*static, *arrays)

    if otherwise in ("attention", "formulas"):
        openjax.kernels.attention.on_platform = formula
    if otherwise in ("normalisation", "formulas"):
        openjax.kernels.normalisation.on_platform = formula
    if otherwise == "body":
        openjax.vehicle.rigid_kernel.on_platform = formula


def _processor_seconds():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _counted(text):
    """Of an optimised program: its instructions, fusions and calls of libraries."""
    kinds = collections.Counter(re.findall(r"^\s+(?:ROOT )?%?[\w.\-]+ = .*? ([a-z][\w\-]*)\(", text, re.M))
    calls = collections.Counter(re.findall(r'custom_call_target="([^"]+)"', text))
    return {"instructions": sum(kinds.values()), "fusions": kinds["fusion"], "library_calls": dict(calls)}


def _profiled(step, carry):
    """The kernels of one step; none where the device tells nothing."""
    import jax

    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(step(carry))
        [file] = Path(folder).rglob("*.xplane.pb")
        return jax.profiler.ProfileData.from_file(str(file))


def _by_phase(profile, text, case, raw):
    """Milliseconds of each phase and of the longest kernels; empty where the device tells nothing."""
    events = list(_kernels(profile))
    names = dict(re.findall(r'%?([\w.\-]+) = [^\n]*metadata={[^}]*op_name="([^"]*)"', text))
    by_kernel = {name.replace(".", "_").replace("-", "_"): path for name, path in names.items()}
    phases, kernels, phase = collections.Counter(), collections.defaultdict(lambda: [0, 0.0]), "other"
    for name, operation, duration in events:
        path = names.get(operation) or by_kernel.get(name, "")
        phase = next((part for part in PHASES if f"/{part}/" in f"{path}/"), phase)
        phases[phase] += duration / 1e6
        total = kernels[phase, name, operation, path[-120:]]
        total[0], total[1] = total[0] + 1, total[1] + duration / 1e6
    longest = sorted(((ms, number, *key) for key, (number, ms) in kernels.items()), reverse=True)
    if raw is not None:
        raw.mkdir(parents=True, exist_ok=True)
        stem = case.replace(":", "_")
        (raw / f"{stem}.kernels.json.gz").write_bytes(gzip.compress(json.dumps(longest).encode()))
        (raw / f"{stem}.hlo.gz").write_bytes(gzip.compress(text.encode()))
    return {
        "phases": dict(phases),
        "kernels_run": len(events),
        "kernels": len(kernels),
        "longest": longest[:12],
    }


def _kernels(profile) -> Iterator[tuple[str, str, float]]:
    """(kernel, the program's operation, ns) of what ran on a GPU, or of the operations of a CPU, in the order of time."""
    lines = [
        (plane.name.startswith("/device:GPU"), line)
        for plane in profile.planes
        for line in plane.lines
        if line.name.startswith(("Stream", "tf_XLA"))
    ]
    on_gpu, found = any(gpu for gpu, _ in lines), []
    for _, line in (one for one in lines if one[0] == on_gpu):
        for event in line.events:
            operation = str(dict(event.stats).get("hlo_op", ""))
            # on a CPU, loops and calls are told beside what is in them
            if on_gpu or (operation and not operation.startswith(("while", "call", "conditional"))):
                found.append((event.start_ns, event.name, operation, event.duration_ns))
    for _, *kernel in sorted(found):
        yield tuple(kernel)


def study(options: argparse.Namespace) -> dict:
    """All cases: compiled side by side, timed one by one as they are given, those first that are ready when time is short."""
    began = time.monotonic()
    workers = [_Worker(case, options.raw, place) for place, case in enumerate(options.cases)]
    while any(not worker.answered.is_set() for worker in workers) and time.monotonic() - began < options.wait:
        time.sleep(0.2)
    timed = []
    for worker in workers:
        if time.monotonic() - began > options.limit or not worker.answered.is_set():
            worker.process.kill()
        elif worker.time():
            timed.append(worker)
    return {"records": [record for worker in timed if (record := worker.told())]}


class _Worker:
    """A process that measures one case; the first ones' compilers come first."""

    def __init__(self, case: str, raw: Path | None, place: int):
        case, _, tree = case.partition("@")
        self.tree = Path(tree).resolve()
        environment = {**os.environ, "PYTHONPATH": f"{self.tree / 'src'}:{self.tree}"}
        command = ["nice", "-n", str(place), sys.executable, "-m", "experiments.speed.steps", "--one", case]
        command += ["--raw", str(raw.resolve() / self.tree.name)] if raw else []
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=self.tree,
            env=environment,
        )
        self.answered = threading.Event()
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self):
        self.process.stdout.readline()
        self.answered.set()

    def time(self) -> bool:
        """Have it timed, and wait; whether it was."""
        if self.process.poll() is not None:
            return False
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        return self.process.stdout.readline() != ""

    def told(self) -> dict | None:
        """What it found; None where it failed."""
        out, _ = self.process.communicate()
        if self.process.returncode != 0:
            return None
        record = {"sources": self.tree.name, **json.loads(out)}
        print(json.dumps({key: value for key, value in record.items() if key != "longest"}), flush=True)
        return record


def page(results: dict) -> Page:
    """A row per case."""
    columns = {
        "preset": "preset",
        "worlds": "worlds:,",
        "otherwise": lambda record: OTHERWISE[record["otherwise"]],
        "ms": "ms:.1f",
        "env steps/s": "steps_per_second:,.0f",
        "instructions compiled": "instructions:,",
        "compiler, processor seconds": "compile_processor_seconds:.0f",
    }
    shown = [name for name in PHASES if any(name in record["phases"] for record in results["records"])]
    columns |= {f"`{name}`, ms": f"phases.{name}:.1f" for name in shown}
    return Page("The training step, phase by phase", "", Table(columns, results["records"]))


def main(arguments: list[str]) -> int:
    """All cases, or one in this process."""
    parser = page_parser(__doc__, "steps")
    parser.add_argument("--cases", nargs="+", default=["paper:5120", "paper:20480"])
    parser.add_argument("--one", help="measure this case here, when a line comes in")
    parser.add_argument("--raw", type=Path, help="folder for all kernels and the compiled programs")
    parser.add_argument(
        "--wait", type=float, default=float("inf"), help="s after which the unready are left out"
    )
    parser.add_argument(
        "--limit", type=float, default=float("inf"), help="s after which nothing more is timed"
    )
    options = parser.parse_args(arguments)
    if options.one:
        print(json.dumps(measure(options.one, options.raw)))
        return 0
    publish(options, study, page)
    return 0


if __name__ == "__main__":
    run_command(main)

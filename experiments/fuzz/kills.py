"""A tiny training run killed (SIGKILL) at an instant, and gone on with: its bits must be those of the run nobody killed."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

import numpy as np

from experiments.fuzz.damages import TINY

FAST = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
"""Flags of the compiler: little is computed here, and much compiled."""
if metadata.version("jaxlib").startswith("0.10."):
    FAST += " --xla_cpu_use_fusion_emitters=false"  # a third of the time to compile

LONGEST_RUN = 900.0
"""Seconds after which a run that should end by itself is taken for stuck."""


def train(
    run: Path, updates: int, *options: str, cache: Path, kill_after: float | None = None
) -> tuple[int, float, str, str]:
    """A tiny run in its own process: its status, seconds, errors and last words; killed after so many seconds."""
    steps = str(updates * 16 * 10)
    command = [sys.executable, "-m", "openjax.train"]
    command += (
        list(options) if "--resume" in options else [*TINY, "--steps", steps, "--out", str(run), *options]
    )
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PLATFORMS": "cpu"}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    environment["XLA_FLAGS"] = FAST
    environment["PYTHONUNBUFFERED"] = "1"
    environment["MUJOCO_GL"] = "off"  # the animation is matplotlib's, in a fraction of the time
    started = time.monotonic()
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=errors, text=True)
        try:
            process.wait(kill_after or LONGEST_RUN)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        seconds = time.monotonic() - started
        output.seek(0), errors.seek(0)
        return process.returncode, seconds, errors.read()[-500:], output.read()


def result_of(run: Path) -> dict[str, bytes]:
    """All bits of the last training state and of the policy of a run."""
    from openjax.store.checkpoint_files import load_arrays
    from openjax.store.checkpoints import Checkpoints
    from openjax.store.policy_files import load_policy_file

    record = Checkpoints(run / "checkpoints").latest()
    state = {name: leaf.tobytes() for name, leaf in load_arrays(record.path).items()}
    policy = {
        f"policy.npz {name}": leaf.tobytes() for name, leaf in load_policy_file(run / "policy.npz")[0].items()
    }
    return {"update": str(record.update).encode(), **state, **policy}


def undisturbed(scratch: Path, updates: int, cache: Path) -> tuple[dict[str, bytes], float]:
    """The bits of a run that nobody kills, and the seconds that it takes once its programs are in the cache."""
    train(scratch / "first", updates, cache=cache)
    status, seconds, errors, _ = train(scratch / "whole", updates, cache=cache)
    if status:
        raise SystemExit(f"the run itself failed: {errors}")
    return result_of(scratch / "whole"), seconds


def instants(seconds: float, number: int) -> list[float]:
    """So many instants from the first second on to the end, in an order whose beginning already covers them all."""
    spread = np.linspace(1.0, seconds, number)
    return [float(spread[i]) for i in np.random.default_rng(0).permutation(number)]


def try_kill(folder: Path, updates: int, seconds: float, expected: dict, cache: Path) -> dict:
    """Kill a run after some seconds, sooner where it had ended by then, and let it go on as a user would."""
    run = folder / f"killed_{seconds:.2f}"
    while (found := train(run, updates, cache=cache, kill_after=seconds))[0] == 0:
        shutil.rmtree(run)
        seconds *= 0.6  # what others do beside it changes how long a run takes
    words = found[3]
    facts = {"seconds": round(seconds, 1), "moment": _moment(words)}
    facts["checkpoints"] = len(list((run / "checkpoints").glob("*.sha256")))
    options = ("--resume", str(run)) if (run / "settings.json").exists() else ()
    facts["went_on_by"] = "--resume" if options else "the same command"
    status, _, errors, _ = train(run, updates, *options, cache=cache)
    if status != 0:
        return {**facts, "outcome": f"failed with {status}: {errors}"}
    result = result_of(run)
    different = [name for name in expected if result.get(name) != expected[name]]
    shutil.rmtree(run)
    return {**facts, "outcome": f"other bits in {different[:3]}" if different else "the same bits"}


def _moment(words):
    """What a run was doing by what it said last."""
    said = [line.removesuffix(" ...") for line in words.splitlines() if line.endswith(" ...")]
    return said[-1].removeprefix("openjax.train: ").partition(":")[0] if said else "starting"

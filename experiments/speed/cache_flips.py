"""Flipped bits in entries of the compilation cache: each start after one ends well and gives the same numbers.

`python -m experiments.speed.cache_flips --flips 500 --json experiments/results/cache_flips.json`
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

BATCH = 25
"""Flips in one process; after a death what it printed tells which one it was."""

START = """
import os, sys
import jax, jax.numpy as jnp
import numpy as np
from openjax.store.checked_cache import ENTRY
from openjax.store.compiled_programs import cache_programs
from openjax.vehicle import hover_state, load_vehicle, make_drones_step

folder, seed, flips = cache_programs(), int(sys.argv[1]), int(sys.argv[2])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
vehicle = load_vehicle()
step = make_drones_step("rigid", substeps=2)
start = hover_state(vehicle, jnp.array([[0.0, 0.0, 0.5], [0.3, 0.0, 0.6], [-0.3, 0.1, 0.7]]))
pillars = jnp.array([[0.2, 0.2]]), jnp.array([True])

def fly(drones):
    command = jnp.tile(jnp.array([0.7, 1.0, -1.0, 0.5]), (3, 1))
    return jax.lax.scan(lambda d, _: (step(vehicle, d, command, *pillars), d.position), drones, None, length=20)

rng = np.random.default_rng(seed)
for flip in range(flips + 1):
    if flip:
        (file,) = folder.glob(f"jit_fly*{ENTRY}")
        content = bytearray(file.read_bytes())
        bit = int(rng.integers(8 * len(content)))
        content[bit // 8] ^= 1 << bit % 8
        file.write_bytes(content)
    jax.clear_caches()
    print(np.asarray(jax.jit(fly)(start)[1]).tobytes().hex(), flush=True)
"""


def run_flips(flips: int, cache: Path, seed: int = 0) -> dict:
    """Counts over so many flips, each followed by a start that loads the entry."""
    found = {"flips": 0, "deaths": 0, "other_numbers": 0, "noticed": 0}
    expected = None
    while found["flips"] < flips:
        number = min(BATCH, flips - found["flips"])
        command = [sys.executable, "-c", START, str(seed + found["flips"]), str(number)]
        ran = subprocess.run(
            command, capture_output=True, text=True, env=_environment(cache), cwd=Path(__file__).parents[2]
        )
        numbers = ran.stdout.split()
        expected = expected or numbers[0]
        found["other_numbers"] += sum(entry != expected for entry in numbers)
        found["noticed"] += ran.stderr.count("is damaged")
        found["deaths"] += ran.returncode != 0
        found["flips"] += number if ran.returncode == 0 else max(len(numbers), 1)
    return found


def _environment(cache):
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PLATFORMS": "cpu"}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flips", type=int, default=500)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run_flips(arguments.flips, Path(folder))
    print(found)
    if arguments.json:
        from openjax.commands.machine import describe_machine

        arguments.json.write_text(json.dumps({**found, **describe_machine()}, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""How many kernels does a program become on a GPU? `python -m experiments.compiled_kernels [--programs training ...]`.

Compiles the rigid step of many drones (as XLA splits it and as one kernel) and the paper preset's training step, and counts
what each loop starts per turn. For the GPU that is there, or, with JAX's CUDA compiler alone (`pip install "jax[cuda13]"`),
for an H200 that isn't: nothing can be tuned by measuring then, so some products may become other kernels on a real one.
Writes experiments/results/compiled_kernels.json and .md; `--report` writes the latter again from the former.
"""

import argparse
import importlib
import re
import time
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import topologies
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments.pages import page_parser, publish, table, where
from openjax.commands.command_line import run_command
from openjax.errors import UserError
from openjax.learning import abstract_carry, make_training_step, preset
from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.rigid_kernel import mapped_step

# Facts of the device that the compiler asks for; from XLA's own list (openxla/xla, xla/backends/gpu/target_config/specs).
H200 = """
gpu_device_info {
  name: "NVIDIA H200 141GB HBM3e"  device_vendor: "NVIDIA Corporation"
  cuda_compute_capability { major: 9 feature_extension: ACCELERATED_FEATURES }
  core_count: 132  fpus_per_core: 128  clock_rate_ghz: 1.98
  threads_per_block_limit: 1024  threads_per_warp: 32  threads_per_core_limit: 2048
  block_dim_limit_x: 2147483647  block_dim_limit_y: 65535  block_dim_limit_z: 65535
  thread_dim_limit_x: 1024  thread_dim_limit_y: 1024  thread_dim_limit_z: 64
  registers_per_core_limit: 65536  registers_per_block_limit: 65536
  shared_memory_per_block: 49152  shared_memory_per_core: 233472  shared_memory_per_block_optin: 232448
  memory_bandwidth: 4800000000000  l2_cache_size: 52428800  device_memory_size: 151397597184
  driver_version: "13.0.0"  runtime_version: "13.0.0"  compile_time_toolkit_version: "13.0.0"  dnn_version: "9.10.0"
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 }
device_description_str: "NVIDIA H200 141GB HBM3e"
"""
STARTED = ("fusion", "custom-call", "copy")
"""Instructions that start a kernel each."""
STEPS = 50
PROGRAMS = ("rigid", "kernel", "training")


def h200() -> Mesh:
    """An H200 that isn't there.

    Raises:
        UserError: JAX's CUDA compiler isn't installed.
    """
    for plugin in ("jax_plugins.xla_cuda13", "jax_plugins.xla_cuda12"):
        try:
            importlib.import_module(plugin)
            break
        except ImportError:
            continue
    else:
        raise UserError('JAX\'s CUDA compiler is not installed; pip install "jax[cuda13]" would bring it')
    topology = topologies.get_topology_desc("h200", "cuda", target_config=H200, topology="1x1x1")
    return Mesh(np.asarray(topology.devices), ("devices",))


def compiled_text(program, *arguments) -> str:
    """The optimised program for arguments of these shapes."""
    if jax.default_backend() == "gpu":
        return jax.jit(program).lower(*arguments).compile().as_text()
    # mapped over the one device, so that kernels know which it is
    mesh, whole = h200(), PartitionSpec()
    mapped = jax.shard_map(program, mesh=mesh, in_specs=whole, out_specs=whole, check_vma=False)
    at = NamedSharding(mesh, whole)
    placed = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=at), arguments)
    return jax.jit(mapped).lower(*placed).compile().as_text()


def loops(text: str) -> list[dict]:
    """Of each loop: its turns, and how many of the `STARTED` instructions one turn has (those of inner loops apart)."""
    bodies = dict(re.findall(r"(?ms)^(?:ENTRY )?(%[\w.\-]+) \([^\n]*\{\n(.*?)^\}", text))

    def started(name: str) -> Counter:
        instructions = re.findall(r" = .*? ([a-z][\w\-]*)\(", bodies[name])
        counts = Counter(instruction for instruction in instructions if instruction in STARTED)
        # kernels that are launched together, as a CUDA graph
        for called in re.findall(r" call\(.*to_apply=(%[\w.\-]+)", bodies[name]):
            counts += started(called)
        return counts

    found = []
    for body in bodies.values():
        for line in re.findall(r"^.* while\(.*$", body, re.M):
            turns = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
            counts = started(re.search(r"body=(%[\w.\-]+)", line).group(1))
            found.append({"turns": int(turns.group(1)) if turns else None, **counts})
    return found


def rigid_step(drones: int, one_kernel: bool) -> str:
    """Steps of the nominal vehicle in free flight."""
    vehicle, step = load_vehicle(), make_drones_step(physics="rigid", dt=0.002, contacts=False)

    def one(drone, command):
        if one_kernel:
            return step(vehicle, drone, command, jnp.zeros((1, 2)), jnp.zeros(1, bool))
        return mapped_step(step.fused, vehicle, drone, command, ())

    def run(drone, command):
        return jax.lax.scan(lambda d, _: (one(d, command), None), drone, None, length=STEPS)[0]

    state = jax.eval_shape(lambda: hover_state(vehicle, jnp.zeros((drones, 3))))
    command = jax.ShapeDtypeStruct((drones, 4), jnp.float32)
    return compiled_text(run, state, command)


def study(options: argparse.Namespace) -> dict:
    """Compile and count."""
    settings = preset("paper")
    programs = {
        "rigid": (
            f"rigid step of {options.drones:,} drones, XLA's",
            lambda: rigid_step(options.drones, False),
        ),
        "kernel": (
            f"rigid step of {options.drones:,} drones, one kernel",
            lambda: rigid_step(options.drones, True),
        ),
        "training": (
            "training step of the paper preset",
            lambda: compiled_text(make_training_step(settings), abstract_carry(settings)),
        ),
    }
    found = {}
    for name in options.programs:
        title, program = programs[name]
        started = time.monotonic()
        found[title] = loops(program())
        print(f"{title}: {time.monotonic() - started:.0f} s", flush=True)
    return {"programs": found, "measured": jax.default_backend() == "gpu"}


def report(results: dict) -> list[str]:
    """The page."""
    untuned = "For an H200 that wasn't there: not tuned by measuring, as on a real one. "
    lines = [
        "# Kernels that a loop starts per turn",
        "",
        f"{where(results)} {'' if results.get('measured') else untuned}"
        "A turn of the training step's loops is a step of the rollout, "
        "a step of the predictor's update and a gradient step of the policy's update; the loop of two fusions sums advantages.",
        "",
    ]
    rows = []
    for name, found in results["programs"].items():
        for loop in found:
            counts = [loop.get(kind, 0) for kind in STARTED]
            rows.append([name, *map(str, (loop["turns"], *counts, sum(counts)))])
    return lines + table(["program", "turns", *STARTED, "together"], rows)


def main(arguments: list[str]) -> int:
    """Compile, count, write both files."""
    parser = page_parser(__doc__, "compiled_kernels")
    parser.add_argument("--drones", type=int, default=32_768)
    parser.add_argument(
        "--programs",
        nargs="+",
        choices=PROGRAMS,
        default=list(PROGRAMS),
        help="which to compile; default: all",
    )
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)

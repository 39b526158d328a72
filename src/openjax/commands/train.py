"""Train pursuers: `openjax train [--preset NAME] [--out DIR] [--any.setting value]`.

Writes a run directory (see `openjax.store.run_directory`) with logs, checkpoints, the best policy
and pictures. Ctrl-C or SIGTERM saves and exits; `--resume DIR` goes on exactly where it stopped.
From Python: `openjax.train(settings, out)`, see `openjax.commands.calls.train`.
"""

import time
from collections.abc import Sequence

from openjax.command_line import parse, peek


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    start_time = time.monotonic()
    if {"-h", "--help"} & set(arguments):
        return _help(arguments)
    if peek(arguments, "process_id") in (None, "0"):
        # takes seconds; nobody should wonder
        print("openjax.train: loading JAX and MuJoCo ...", flush=True)
    import jax

    from openjax.cluster.joining import join
    from openjax.platform import make_cores_devices
    from openjax.runs.request import membership, read_command
    from openjax.runs.start import start

    # the same numbers by a kernel of JAX's own: written out, they're half of what there
    # is to compile for a GPU
    jax.config.update("jax_threefry_gpu_kernel_lowering", True)
    place = membership(arguments)
    if place is None and peek(arguments, "devices") != "all":
        make_cores_devices()
    with join(place) as processes:
        return start(read_command(arguments), arguments, start_time, processes)


def _help(arguments):
    """The options and a preset's defaults, without waiting for JAX to find its devices."""
    from openjax.learning.presets import preset
    from openjax.runs.train_command import PROGRAM, TrainCommand

    default = TrainCommand(settings=preset(peek(arguments, "preset") or "quick"))
    parse(TrainCommand, default, ["--help"], PROGRAM)  # prints and exits

"""Train pursuers: `python -m openjax.train [--preset quick|paper] [--out DIR] [--any.setting value]`.

Writes a run directory (see `openjax.runs.run_directory`) with logs, checkpoints, the best policy and
pictures. Ctrl-C or SIGTERM saves and exits; `--resume DIR` goes on exactly where it stopped.
"""

import sys
import time
from collections.abc import Sequence

from openjax.runs.command_line import run_command


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    started = time.monotonic()
    if not {"-h", "--help"} & set(arguments):
        print("openjax.train: loading JAX and MuJoCo ...", flush=True)  # takes seconds; nobody should wonder
    from openjax.runs.training_command import read_command, start

    return start(read_command(arguments), arguments, started)


if __name__ == "__main__":
    sys.exit(run_command(main))

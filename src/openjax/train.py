"""`openjax train`: the command is `openjax.commands.train`."""

import functools

from openjax.commands.command_line import run_command
from openjax.commands.train import main

if __name__ == "__main__":
    run_command(functools.partial(main, keep_traced=True))

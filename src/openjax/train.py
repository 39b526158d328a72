"""`openjax train`: the command is `openjax.commands.train`."""

from openjax.commands.command_line import run_command
from openjax.commands.train import main

if __name__ == "__main__":
    run_command(main)

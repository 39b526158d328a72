"""`openjax evaluate`: the command is `openjax.commands.evaluate`."""

from openjax.commands.command_line import run_command
from openjax.commands.evaluate import main

if __name__ == "__main__":
    run_command(main)

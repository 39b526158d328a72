"""`python -m openjax.export`: the command is `openjax.commands.export`."""

from openjax.commands.command_line import run_command
from openjax.commands.export import main

if __name__ == "__main__":
    run_command(main)

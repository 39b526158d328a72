"""`python -m openjax.benchmark`: the command is `openjax.commands.benchmark`."""

from openjax.commands.benchmark import main
from openjax.commands.command_line import run_command

if __name__ == "__main__":
    run_command(main)

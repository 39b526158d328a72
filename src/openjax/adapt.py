"""`python -m openjax.adapt`: the command is `openjax.commands.adapt`."""

from openjax.commands.adapt import main
from openjax.commands.command_line import run_command

if __name__ == "__main__":
    run_command(main)

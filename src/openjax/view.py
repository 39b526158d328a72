"""`python -m openjax.view`: the command is `openjax.commands.view`."""

from openjax.commands.command_line import run_command
from openjax.commands.view import main

if __name__ == "__main__":
    run_command(main)

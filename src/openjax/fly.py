"""`python -m openjax.fly`: the command is `openjax.commands.fly`."""

from openjax.commands.command_line import run_command
from openjax.commands.fly import main

if __name__ == "__main__":
    run_command(main)

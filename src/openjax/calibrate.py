"""`python -m openjax.calibrate`: the command is `openjax.commands.calibrate`."""

from openjax.commands.calibrate import main
from openjax.commands.command_line import run_command

if __name__ == "__main__":
    run_command(main)

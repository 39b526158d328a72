"""`python -m openjax.virtual_crazyflie`: the command is `openjax.commands.virtual_crazyflie`."""

from openjax.command_line import run_command
from openjax.commands.virtual_crazyflie import main

if __name__ == "__main__":
    run_command(main)

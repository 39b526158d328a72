"""`python -m openjax.sample_flights`: the command is `openjax.commands.sample_flights`."""

from openjax.commands.command_line import run_command
from openjax.commands.sample_flights import main

if __name__ == "__main__":
    run_command(main)

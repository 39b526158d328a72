"""`openjax diagnose`: the command is `openjax.commands.diagnose`."""

from openjax.commands.command_line import run_command
from openjax.commands.diagnose import main

if __name__ == "__main__":
    run_command(main)

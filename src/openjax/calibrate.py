"""`python -m openjax.calibrate`: the command is `openjax.commands.calibrate`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("calibrate")

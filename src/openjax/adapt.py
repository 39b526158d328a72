"""`python -m openjax.adapt`: the command is `openjax.commands.adapt`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("adapt")

"""`python -m openjax.map`: the command is `openjax.commands.map`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("map")

"""`python -m openjax.export`: the command is `openjax.commands.export`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("export")

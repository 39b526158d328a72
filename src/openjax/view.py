"""`python -m openjax.view`: the command is `openjax.commands.view`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("view")

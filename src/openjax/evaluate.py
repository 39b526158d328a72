"""`python -m openjax.evaluate`: the command is `openjax.commands.evaluate`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("evaluate")

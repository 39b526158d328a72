"""`python -m openjax.mix`: the command is `openjax.commands.mix`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("mix")

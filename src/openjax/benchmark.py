"""`python -m openjax.benchmark`: the command is `openjax.commands.benchmark`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("benchmark")

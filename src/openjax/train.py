"""`python -m openjax.train`: the command is `openjax.commands.train`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("train")

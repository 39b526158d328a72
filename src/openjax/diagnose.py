"""`python -m openjax.diagnose`: the command is `openjax.commands.diagnose`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("diagnose")

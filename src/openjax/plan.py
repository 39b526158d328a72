"""`python -m openjax.plan`: the command is `openjax.commands.plan`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("plan")

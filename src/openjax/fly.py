"""`python -m openjax.fly`: the command is `openjax.commands.fly`."""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("fly")

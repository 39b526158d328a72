"""`python -m openjax.virtual_crazyflie`: the command is
`openjax.commands.virtual_crazyflie`.
"""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("virtual_crazyflie")

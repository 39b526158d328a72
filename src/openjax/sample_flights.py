"""`python -m openjax.sample_flights`: the command is
`openjax.commands.sample_flights`.
"""

from openjax.__main__ import entry

if __name__ == "__main__":
    entry("sample_flights")

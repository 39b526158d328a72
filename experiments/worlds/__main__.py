"""`python -m experiments.worlds`: see `experiments.worlds.study`. Workers can't import what stands in a `__main__`."""

from experiments.worlds.study import main

if __name__ == "__main__":
    main()

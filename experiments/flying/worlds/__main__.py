"""`python -m experiments.flying.worlds`: see `experiments.flying.worlds.study`."""

from experiments.flying.single_thread import use_single_thread

if __name__ == "__main__":
    use_single_thread()  # before JAX is imported
    from experiments.flying.worlds.study import main

    main()

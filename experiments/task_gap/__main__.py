"""`python -m experiments.task_gap`: see `experiments.task_gap.study`."""

from experiments.single_thread import use_single_thread

if __name__ == "__main__":
    use_single_thread()  # before JAX is imported
    from experiments.task_gap.study import main

    main()

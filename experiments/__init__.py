"""Programs that measured what the results say; all run from the repository's root as `python -m
experiments.NAME`.

Each writes its page into `experiments/results/`. Several need `table`, which makes pages from
stored results, and `figures`, which writes the numbers that README and pages show.
"""

"""Programs that measured what the results say; all run from the repository's root as
`python -m experiments.NAME`.

Each writes its page into `experiments/results/`. What several need is here too: `table`
(pages from stored results), `roster` (the methods of the tables), `flights` (episodes
of a policy).
"""

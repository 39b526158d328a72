"""The paper's table of its parts on layouts unlike its training (`tab:ood`): `python -m experiments.tab_ood`.

OPEN, MAPPO with either part, and plain MAPPO in random and passage, from what tables.py stored; the paper's values beside
ours. Writes experiments/results/tab_ood.md.
"""

import functools

from experiments.pages import page_from_tables, spread, table, where
from experiments.tab_main import FIGURES, rows_of
from openjax.commands.command_line import run_command

VARIANTS = ("OPEN", "MAPPO + predictor", "MAPPO + generator", "MAPPO")
PAPER = {
    "random": {
        "OPEN": ("1.000 (0.000)", "329.9 (60.6)", "0.011 (0.008)"),
        "MAPPO + predictor": ("1.000 (0.000)", "301.0 (28.7)", "0.012 (0.009)"),
        "MAPPO + generator": ("0.967 (0.025)", "477.1 (44.8)", "0.107 (0.110)"),
        "MAPPO": ("0.783 (0.272)", "493.8 (183.6)", "0.168 (0.160)"),
    },
    "passage": {
        "OPEN": ("1.000 (0.000)", "329.6 (76.9)", "0.006 (0.008)"),
        "MAPPO + predictor": ("0.886 (0.120)", "427.6 (123.0)", "0.013 (0.010)"),
        "MAPPO + generator": ("0.727 (0.193)", "602.2 (41.1)", "0.216 (0.292)"),
        "MAPPO": ("0.617 (0.275)", "541.0 (144.9)", "0.013 (0.008)"),
    },
}


def report(results: dict) -> list[str]:
    """The page."""
    rows = []
    for layout, of_paper in PAPER.items():
        for variant in VARIANTS:
            records = rows_of(results["flights"], variant, "clamp", layout)
            ours = [spread([row[name] for row in records], digits) for name, digits in FIGURES.items()]
            cells = [f"{own} / {theirs}" for own, theirs in zip(ours, of_paper[variant], strict=False)]
            rows.append([layout, variant, *cells, ours[-1]])
    return [
        "# The paper's parts on layouts unlike its training",
        "",
        f"{where(results)} {results['episodes']} episodes per training seed and layout, speed clamp, drawn starts; ours / the "
        "paper's, mean (standard deviation over seeds). How the variants were trained, and that their penalties were chosen "
        "for OPEN (plain MAPPO's anew, preset `mappo`): ablations.md.",
        "",
        *table(["layout", "variant", *(name.replace("_", " ") for name in FIGURES)], rows),
    ]


main = functools.partial(page_from_tables, __doc__, "tab_ood", report)


if __name__ == "__main__":
    run_command(main)

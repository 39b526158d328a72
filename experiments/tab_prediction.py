"""The paper's table of prediction errors: `python -m experiments.tab_prediction`, from what tables.py stored.

Error of the evader's predicted next position over whole episodes of OPEN, beside that of keeping where it was last seen and
the paper's. Writes experiments/results/tab_prediction.md.
"""

import functools

from experiments.headline import PAPER_PREDICTION
from experiments.pages import page_from_tables, spread, table, where
from experiments.tab_main import rows_of
from openjax.commands.command_line import run_command


def report(results: dict) -> list[str]:
    """The page."""
    rows = []
    for layout in (*PAPER_PREDICTION, "hidden"):
        records = rows_of(results["flights"], "OPEN", "clamp", layout)
        cells = [
            spread([row[name] for row in records], 4) for name in ("prediction_error", "last_seen_error")
        ]
        rows.append([layout, *cells, f"{PAPER_PREDICTION[layout]}" if layout in PAPER_PREDICTION else "–"])
    return [
        "# Prediction errors (m)",
        "",
        f"{where(results)} Mean distance between the predicted and the true next position over all steps, "
        f"{results['episodes']} episodes per training seed, speed clamp; mean (standard deviation over seeds). "
        "`hidden` isn't in the paper.",
        "",
        *table(["layout", "OPEN", "keeping the last seen position", "paper"], rows),
    ]


main = functools.partial(page_from_tables, __doc__, "tab_prediction", report)


if __name__ == "__main__":
    run_command(main)

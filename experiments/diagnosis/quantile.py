"""What the diagnosis is calibrated with: cases with known answers, of several worlds.

    python -m experiments.diagnosis.quantile CASES.jsonl … --source WORDS --out
    src/openjax/gap/residual.json

Reads what `development` wrote. Writes the residual check's measures over all cases in
which nothing unknown acts, whatever was named: the engine takes conformal p-values
among them (Vovk, Gammerman, Shafer 2005). Prints the temperature of the probabilities
under which the right classes are likeliest (Guo et al. 2017), beside the one in use.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

from experiments.diagnosis.development import read_lines
from openjax.files import write_json
from openjax.gap.decision import DECISION
from openjax.gap.probabilities import temper

WITHOUT = ("unknown", "garbage")
# probability of a class that was ruled out: one case must not decide alone
FLOOR = 1e-3


def measures_of(lines: list[dict]) -> list[dict[str, float]]:
    """The residual's measures in the cases in which nothing unknown acts."""
    good = [
        r["residual"]
        for r in lines
        if r["category"] not in WITHOUT and r.get("residual")
    ]
    return [
        {n: float(f"{v:.4g}") for n, v in r.items() if n != "p_value"} for r in good
    ]


def best_temperature(lines: list[dict]) -> float:
    """The temperature that makes the right classes likeliest, from probabilities made
    at the one in use.
    """
    told = [
        (r["probabilities"], r["right_names"]) for r in lines if r.get("probabilities")
    ]

    def loss(logarithm: float) -> float:
        cases = [
            (temper(p, np.exp(logarithm) / DECISION.temperature), right)
            for p, right in told
        ]
        return -sum(
            np.log(max(sum(p.get(n, 0.0) for n in right), FLOOR)) for p, right in cases
        )

    return float(np.exp(minimize_scalar(loss, bounds=(-1.0, 3.0), method="bounded").x))


def main() -> None:
    """Write the calibration."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="+", type=Path)
    parser.add_argument(
        "--source", required=True, help="which cases these are, in words"
    )
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    lines = read_lines(options.cases)
    cases = measures_of(lines)
    write_json(options.out, {"source": options.source, "cases": cases})
    graded = [r for r in lines if r["category"] not in ("garbage", "real")]
    print(
        f"{len(cases)} cases; temperature {best_temperature(graded):.2f}, in use "
        f"{DECISION.temperature}"
    )


if __name__ == "__main__":
    main()

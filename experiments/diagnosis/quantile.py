"""What the diagnosis is calibrated with: cases with known answers, of several worlds.

    python -m experiments.diagnosis.quantile CASES.jsonl … --referred CASES.jsonl …
    --source WORDS --out src/openjax/gap/residual.json

Reads what `development` wrote, without references and with them (`--healthy`). Writes
the residual check's measures over all cases in which nothing unknown acts, whatever was
named: the engine takes conformal p-values among them (Vovk, Gammerman, Shafer 2005).
Without any CASES those of the file stay. Prints the reliability of the probabilities
under which the right classes are likeliest, beside the one in use.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

from experiments.diagnosis.development import read_lines
from openjax.files import write_json
from openjax.gap.decision import DECISION
from openjax.gap.residual import calibration

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


def pairs_of(lines: list[dict]) -> list[dict[str, dict[str, float]]]:
    """The same, and what the reference leaves, of cases that had one."""
    good = [r for r in lines if r.get("residual_before")]
    before = [r | {"residual": r["residual_before"]} for r in good]
    return [
        {"case": case, "reference": reference}
        for case, reference in zip(measures_of(good), measures_of(before), strict=True)
    ]


def best_reliability(lines: list[dict]) -> float:
    """The reliability that makes the right classes likeliest, from probabilities made
    with the one in use.
    """
    told = [
        (r["probabilities"], r["right_names"]) for r in lines if r.get("probabilities")
    ]

    def loss(share: float) -> float:
        change = share / DECISION.reliability
        right = [
            sum(p.get(n, 0.0) * change + (1.0 - change) / len(p) for n in names)
            for p, names in told
        ]
        return -float(np.log(np.maximum(right, FLOOR)).sum())

    return float(minimize_scalar(loss, bounds=(0.5, 1.0), method="bounded").x)


def main() -> None:
    """Write the calibration."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", type=Path)
    parser.add_argument("--referred", nargs="*", type=Path, default=[])
    parser.add_argument(
        "--source", required=True, help="which cases these are, in words"
    )
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    lines = read_lines(options.cases)
    referred = read_lines(options.referred)
    cases = measures_of(lines) if lines else calibration()
    pairs = pairs_of(referred) if referred else calibration("with_reference")
    found = {"source": options.source, "cases": cases, "with_reference": pairs}
    write_json(options.out, found)
    graded = [r for r in lines + referred if r["category"] not in ("garbage", "real")]
    print(
        f"{len(cases)} cases, {len(pairs)} with a reference; reliability "
        f"{best_reliability(graded):.2f}, in use {DECISION.reliability}"
    )


if __name__ == "__main__":
    main()

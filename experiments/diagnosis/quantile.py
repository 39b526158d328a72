"""What the diagnosis is calibrated with: cases with known answers, of several worlds.

    python -m experiments.diagnosis.quantile CASES.jsonl … --referred CASES.jsonl …
    --source WORDS --out src/openjax/gap/residual.json

Reads what `development` wrote, without references and with them (`--healthy`). Writes the residual
check's measures over all cases in which nothing unknown acts, whatever was named: the engine takes
conformal p-values among them (Vovk, Gammerman, Shafer 2005). Without any CASES those of the file
stay. Prints, each beside the one in use, the power of level over p-value that makes the odds of an
unknown cause likeliest, and the reliability of the probabilities under which the right classes are
likeliest.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

from experiments.diagnosis.development import read_lines
from openjax.files import write_json
from openjax.gap.decision import DECISION
from openjax.gap.residual import calibration, rejection_level, standing_out

WITHOUT = ("unknown", "garbage")
# probability of a class that was ruled out: one case must not decide alone
FLOOR = 1e-3


def measures_of(lines: list[dict]) -> list[dict[str, float]]:
    """The residual's measures in the cases in which nothing unknown acts."""
    good = [r["residual"] for r in lines if r["category"] not in WITHOUT and r.get("residual")]
    return [{n: float(f"{v:.4g}") for n, v in r.items() if n != "p_value"} for r in good]


def pairs_of(lines: list[dict]) -> list[dict[str, dict[str, float]]]:
    """The same, and what the reference leaves, of cases that had one."""
    good = [r for r in lines if r.get("residual_before")]
    before = [r | {"residual": r["residual_before"]} for r in good]
    return [
        {"case": case, "reference": reference}
        for case, reference in zip(measures_of(good), measures_of(before), strict=True)
    ]


def best_power(lines: list[dict]) -> float:
    """The power of level over p-value that makes it likeliest in which cases something unknown
    acts.
    """
    told = []
    for line in lines:
        measures = dict(line["residual"])
        p_value = measures.pop("p_value")
        reference = line.get("residual_before") or {}
        _, name = standing_out(measures, reference or None)
        surprise = np.log(rejection_level(name in reference) / p_value)
        told.append((surprise, line["category"] == "unknown"))
    surprises, unknown = np.array(told).T

    def loss(power: float) -> float:
        sign = np.where(unknown, -1.0, 1.0)
        return float(np.logaddexp(0.0, sign * power * surprises).sum())

    return float(minimize_scalar(loss, bounds=(0.3, 5.0), method="bounded").x)


def best_reliability(lines: list[dict]) -> float:
    """The reliability that makes the right classes likeliest, from probabilities made with the one
    in use.
    """
    told = [(r["probabilities"], r["right_names"]) for r in lines if r.get("probabilities")]

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
    parser.add_argument("--source", required=True, help="which cases these are, in words")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    lines = read_lines(options.cases)
    referred = read_lines(options.referred)
    cases = measures_of(lines) if lines else calibration()
    pairs = pairs_of(referred) if referred else calibration("with_reference")
    found = {"source": options.source, "cases": cases, "with_reference": pairs}
    write_json(options.out, found)
    graded = [r for r in lines + referred if r["category"] not in ("garbage", "real")]
    checked = [r for r in graded if r.get("residual")]
    print(
        f"{len(cases)} cases, {len(pairs)} with a reference; power of the odds "
        f"{best_power(checked):.2f}, in use {DECISION.unknown_odds}; reliability "
        f"{best_reliability(graded):.2f}, in use {DECISION.reliability}"
    )


if __name__ == "__main__":
    main()

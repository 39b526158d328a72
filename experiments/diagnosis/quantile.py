"""The threshold of the engine's omnibus check: a conformal quantile over cases in which nothing unknown acts.

    python -m experiments.diagnosis.quantile CASES.jsonl … --level 0.03 --out experiments/results/residual_quantile.json

Reads what `development` wrote. The score of a case is `residual.statistic` of its report. Over n exchangeable cases the
ceil((n + 1)(1 - level))-th smallest score is exceeded by a further one with a probability of at most `level` (Vovk, Gammerman,
Shafer 2005). Worlds aren't exchangeable, so each gets its own quantile, and the largest is the threshold.
"""

import argparse
import math
from pathlib import Path

from experiments.diagnosis.development import read_lines
from openjax.files import write_json

KNOWN = ("none", "not_testable", "single", "pair")


def conformal_quantile(scores: list[float], level: float) -> float:
    """The smallest threshold that a further score exceeds with a probability of at most `level`; inf for too few."""
    rank = math.ceil((len(scores) + 1) * (1 - level))
    return sorted(scores)[rank - 1] if rank <= len(scores) else math.inf


def worlds_of(lines: list[dict]) -> dict[str, list[float]]:
    """World -> scores of its cases without an unknown cause."""
    worlds: dict[str, list[float]] = {}
    for line in lines:
        score = (line.get("residual") or {}).get("statistic")
        if line["category"] in KNOWN and score is not None:
            worlds.setdefault(line["set"], []).append(float(score))
    return worlds


def main() -> None:
    """Write the threshold and the scores that it comes from."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="+", type=Path)
    parser.add_argument("--level", type=float, default=0.03)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    worlds = worlds_of(read_lines(options.cases))
    # a world with fewer cases than the level asks for gives its largest score
    values = {
        world: min(conformal_quantile(scores, options.level), max(scores)) for world, scores in worlds.items()
    }
    found = {"level": options.level, "value": max(values.values()), "worlds": values, "scores": worlds}
    write_json(options.out, found)
    print(found["value"], values)


if __name__ == "__main__":
    main()

"""The calibration of the engine's residual check: its statistics over cases in which nothing unknown acts.

    python -m experiments.diagnosis.quantile CASES.jsonl … --source WORDS --out src/openjax/gap/residual.json

Reads what `development` wrote. Nominal cases in which nothing was named, and cases whose effects were named rightly, whether or
not the check then in use rejected them; the engine takes conformal p-values within each kind (Vovk, Gammerman, Shafer 2005).
"""

import argparse
from pathlib import Path

from experiments.diagnosis.development import read_lines
from openjax.files import write_json

KINDS = {"none": ("none", "not_testable"), "named": ("single", "pair", "real")}
STATISTICS = ("growth",)


def statistics_of(lines: list[dict]) -> dict[str, dict[str, list[float]]]:
    """Kind -> statistic -> its sorted values over the cases of this kind that no wrong name blurs."""

    def clear(line: dict, kind: str) -> bool:
        names = [w for w in line["words"] if w != "unknown"]
        right = line["right"] if kind == "named" else not names
        return right and not line["wrong_names"] and bool(line.get("residual"))

    chosen = {
        kind: [line["residual"] for line in lines if line["category"] in categories and clear(line, kind)]
        for kind, categories in KINDS.items()
    }
    return {k: {s: sorted(round(r[s], 4) for r in chosen[k]) for s in STATISTICS} for k in KINDS}


def main() -> None:
    """Write the calibration."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="+", type=Path)
    parser.add_argument("--source", required=True, help="which cases these are, in words")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    found = statistics_of(read_lines(options.cases))
    write_json(options.out, {"source": options.source, "statistics": found})
    print({kind: len(values["growth"]) for kind, values in found.items()})


if __name__ == "__main__":
    main()

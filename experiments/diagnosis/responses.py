"""How the identified torques of one vehicle change between two sets of flights, where
no effect on torques acts: what a reference's diagnosis may take for a change.

    python -m experiments.diagnosis.responses --sets DIR … --cores 2 --out FILE.json

A set is a folder of cases with its answers and reference flights beside it, as
`generate --healthy` writes them. Stated are quantiles of the lags' changes (ms) and of
the gains' (logarithms) over the cases whose torques can be told in both.
"""

import argparse
import json
import multiprocessing
from pathlib import Path

import numpy as np

from experiments.diagnosis import truth
from experiments.diagnosis.development import answers_of
from experiments.diagnosis.healthy import healthy_beside
from experiments.flying.single_thread import use_single_thread

ON_TORQUES = {
    *("inertia", "yaw_torque", "motor_lag", "rate_gains"),
    *("thrust_scale", "thrust_curve", "thrust_saturation", "battery_sag"),
}
QUANTILES = (0.1, 0.5, 0.9)


def identified(folder: Path) -> dict | None:
    """The estimates of a folder's flights; None where they can't be read."""
    from openjax.errors import UserError
    from openjax.flights.case import load_case
    from openjax.gap.identification.quantities import identify

    try:
        found = identify(load_case(folder))
    except UserError:
        return None
    if found is None:
        return None
    value = found.estimates.value
    lags = (1e3 * value[:2]).tolist()
    return {"trusted": found.trustworthy, "value": lags + np.log(value[2:]).tolist()}


def both(folder: Path) -> tuple[str, dict | None, dict | None]:
    """A case's name, what its flights say and what those of its reference do."""
    return (
        folder.name,
        identified(folder),
        identified(healthy_beside(folder.parent) / folder.name),
    )


def change(here: dict | None, there: dict | None) -> np.ndarray | None:
    """(5,) ms of speeding up and slowing down, logarithms of the inertias about x and y
    and of the yaw torque; None where one of both can't be told.
    """
    if here is None or there is None or not (here["trusted"] and there["trusted"]):
        return None
    return np.array(here["value"]) - np.array(there["value"])


def summary(changes: np.ndarray) -> dict[str, list[float]]:
    """Quantiles of changes (N, 5)."""
    x, y = changes[:, 2:4].T
    columns = {
        "speeding up, ms": changes[:, 0],
        "slowing down, ms": changes[:, 1],
        "inertia about x and y": 0.5 * (x + y),
        "half of what x and y are apart": 0.5 * (x - y),
        "yaw torque and inertia": changes[:, 4] + 0.5 * (x + y),
    }
    return {name: np.quantile(v, QUANTILES).round(4).tolist() for name, v in columns.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", nargs="+", type=Path, required=True)
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    use_single_thread()
    changes = []
    for place in options.sets:
        told = truth.read_answers(answers_of(place))
        quiet = [n for n, a in told.items() if not ON_TORQUES & set(a["effects"])]
        folders = [place / n for n in quiet if told[n]["category"] != "garbage"]
        with multiprocessing.get_context("spawn").Pool(options.cores) as pool:
            found = [change(here, there) for _, here, there in pool.imap(both, folders)]
        changes += [c for c in found if c is not None]
    out = {"cases": len(changes), "quantiles": QUANTILES, "changes": summary(np.array(changes))}
    options.out.write_text(json.dumps(out, indent=1) + "\n")
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()

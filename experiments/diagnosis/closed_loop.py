"""Does the advised flight tell more than a random one? Two hovers that say little, a diagnosis, its
advice, the advised segments flown, a second diagnosis; beside it as many random segments.

    python -m experiments.diagnosis.closed_loop --cases 6 --out experiments/results/closed_loop.json

The plant is openjax' own vehicle with one effect of its sample strength, so this asks for the
advice, not for the diagnosis' strength on foreign vehicles.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from openjax.flights.flight import Case
from openjax.flights.reading import flights_of
from openjax.flights.samples import fly, log_of
from openjax.flights.segments import SEGMENTS
from openjax.gap.diagnosis import diagnose_case
from openjax.gap.planning.beliefs import beliefs_of
from openjax.gap.planning.information import SECONDS, advise
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.vehicle_file import load_vehicle_file

CAUSES = ("rotor_drag", "ground_effect", "wind", "com_offset", "blade_flapping", "thrust_curve")
FLOWN = 2  # segments after the first diagnosis


def flights_along(names, effects, seed: int, described):
    """Flights of segments, flown by a vehicle with effects."""
    found = []
    for number, name in enumerate(names):
        reference = SEGMENTS[name].reference(SECONDS)
        columns = fly(described.vehicle, described.vehicle, reference, 100 * seed + number, effects)
        found += flights_of(log_of(columns, f"{seed}_{number}_{name}"), (0, 1, 2, 3))[0]
    return found


def answer(flights, described):
    """What the diagnosis names first, and its report as JSON has it."""
    report = diagnose_case(Case("closed loop", tuple(flights), described))
    return (report.effects or (report.verdict,))[0], report.to_dict()


def closed_loop(number: int) -> dict:
    """One case: names before, after advised and after random segments."""
    cause = CAUSES[number % len(CAUSES)]
    effects = {cause: EFFECTS[cause].card.sample}
    described = replace(load_vehicle_file(), mass_weighed=True, log={"motor_rows": "mean"})
    hovers = flights_along(("hover", "hover"), effects, 3 * number, described)
    before, report = answer(hovers, described)
    advice = advise(beliefs_of(report), described)
    chosen = list(advice.chosen)
    chosen += [p.segment for p in advice.promises if p.segment not in chosen]
    chosen = chosen[:FLOWN]
    rng = np.random.default_rng(number)
    drawn = [str(n) for n in rng.choice(list(SEGMENTS), FLOWN, replace=False)]
    out = {"cause": cause, "before": before}
    for kind, names in (("advised", chosen), ("random", drawn)):
        more = flights_along(names, effects, 3 * number + 1, described)
        out[kind] = {"segments": names, "named": answer(hovers + more, described)[0]}
    print(out, flush=True)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=len(CAUSES))
    parser.add_argument("--out", type=Path, default=Path("closed_loop.json"))
    arguments = parser.parse_args()
    cases = [closed_loop(number) for number in range(arguments.cases)]
    right = {
        "before": sum(c["before"] == c["cause"] for c in cases),
        "advised": sum(c["advised"]["named"] == c["cause"] for c in cases),
        "random": sum(c["random"]["named"] == c["cause"] for c in cases),
    }
    command = f"python -m experiments.diagnosis.closed_loop --cases {arguments.cases}"
    found = {"command": command, "of": len(cases), "right": right, "cases": cases}
    arguments.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Does the advised flight tell more than a random one? Two hovers that say little, a diagnosis, its
advice, the advised segments flown, the next diagnosis, twice; beside it as many random segments.

    python -m experiments.diagnosis.closed_loop --cases 48 --jobs 32 --out
    experiments/results/closed_loop.json

The plant is openjax' own vehicle with one effect of its sample strength, so this asks for the
advice, not for the diagnosis' strength on foreign vehicles. `--each` also diagnoses the hovers with
each segment alone: which segment shows which cause.
"""

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from experiments.diagnosis.generate import in_processes
from experiments.flying.single_thread import use_single_thread

CAUSES = (
    *("rotor_drag", "ground_effect", "wind", "com_offset", "blade_flapping", "thrust_curve"),
    *("motor_lag", "inertia", "yaw_torque", "battery_sag", "ceiling_effect", "motor_imbalance"),
)
FLOWN = 2  # segments in a round
ROUNDS = 2


@dataclass(frozen=True)
class Case:
    """A vehicle with one cause, whose number also seeds its flights."""

    number: int

    @property
    def cause(self) -> str:
        return CAUSES[self.number % len(CAUSES)]

    def fly(self, segments, round_number: int) -> list:
        """Flights of segments in a round."""
        from openjax.vehicle.effects import EFFECTS

        effects = {self.cause: EFFECTS[self.cause].card.sample}
        names = {f"{round_number}_{place}_{name}": name for place, name in enumerate(segments)}
        return fly_segments(described(), names, 1000 * self.number + 100 * round_number, effects)

    def hovers(self) -> list:
        """The flights that say little, with which every study begins."""
        return self.fly(("hover", "hover"), 0)


def fly_segments(told, names: dict[str, str], seed: int, effects: dict) -> list:
    """Flights of a vehicle with effects in uneven air: segments by the names of their logs, the
    first of them seeded by `seed`.
    """
    from openjax.flights.reading import flights_of
    from openjax.flights.samples import Turbulence, fly, log_of
    from openjax.flights.segments import SEGMENTS
    from openjax.gap.planning.information import SECONDS

    vehicle = told.vehicle
    found = []
    for place, (log, name) in enumerate(names.items()):
        reference = SEGMENTS[name].reference(SECONDS)
        columns = fly(vehicle, vehicle, reference, seed + place, effects, air=Turbulence())
        found += flights_of(log_of(columns, log), (0, 1, 2, 3))[0]
    return found


def described():
    """What the diagnosis is told of the vehicle."""
    from openjax.vehicle.vehicle_file import load_vehicle_file

    return replace(load_vehicle_file(), mass_weighed=True, log={"motor_rows": "mean"})


def diagnose(flights: list, cause: str) -> tuple[dict, dict]:
    """What is kept of a diagnosis of a vehicle with one cause, and its report as JSON has it."""
    from openjax.flights import flight
    from openjax.gap.diagnosis import diagnose_case

    report = diagnose_case(flight.Case("closed loop", tuple(flights), described()))
    named = (report.effects or (report.verdict,))[0]
    likely = {e: round(p, 3) for e, p in report.probabilities.items() if p > 0.03}
    kept = {
        "named": named,
        "right": named == cause,
        "also": list(report.effects[1:]),
        "equivalent": report.equivalent.get(named, []),
        "not_testable": cause in report.not_testable,
        "probabilities": likely,
        "seconds": round(report.seconds, 1),
    }
    return kept, report.to_dict()


def advised(report: dict) -> tuple[list[str], list[dict]]:
    """The segments that the advice would fly, and what it promises."""
    from openjax.gap.planning.beliefs import beliefs_of
    from openjax.gap.planning.information import advise

    advice = advise(beliefs_of(report), described())
    chosen = list(advice.segments)
    chosen += [p.segment for p in advice.promises if p.segment not in chosen]
    return chosen[:FLOWN], [asdict(p) for p in advice.promises]


def advised_rounds(case: Case) -> dict:
    """The hovers' diagnosis, and each round's advice and diagnosis."""
    flights = case.hovers()
    before, report = diagnose(flights, case.cause)
    out = []
    for number in range(1, ROUNDS + 1):
        segments, promises = advised(report)
        flights = flights + case.fly(segments, number)
        kept, report = diagnose(flights, case.cause)
        out.append({"segments": segments, "promises": promises} | kept)
    return {"before": before, "advised": out}


def random_rounds(case: Case) -> dict:
    """Each round's diagnosis after segments that nobody chose."""
    rng = np.random.default_rng(case.number)
    flights = case.hovers()
    out = []
    for number in range(1, ROUNDS + 1):
        segments = [str(n) for n in rng.choice(segment_names(), FLOWN, replace=False)]
        flights = flights + case.fly(segments, number)
        out.append({"segments": segments} | diagnose(flights, case.cause)[0])
    return {"random": out}


def alone(case: Case, segment: str) -> dict:
    """The diagnosis of the hovers and one segment."""
    kept, _ = diagnose(case.hovers() + case.fly((segment,), 1), case.cause)
    return {"each": {segment: kept}}


def segment_names() -> list[str]:
    from openjax.flights.segments import SEGMENTS

    return list(SEGMENTS)


def studied(job: tuple[int, str]) -> tuple[int, dict]:
    """One job: the number of a case and which of its parts, and what came of it."""
    number, part = job
    case = Case(number)
    rounds = {"advised": advised_rounds, "random": random_rounds}
    return number, rounds[part](case) if part in rounds else alone(case, part)


def study(numbers: list[int], jobs: int, each: bool) -> list[dict]:
    """All cases. The longest jobs begin first, so that none is waited for at the end."""
    parts = ["advised", "random", *(segment_names() if each else ())]
    work = [(number, part) for part in parts for number in numbers]
    cases: dict[int, dict] = {n: {"number": n, "cause": Case(n).cause} for n in numbers}
    for number, found in in_processes(studied, work, jobs):
        print(json.dumps({"number": number} | found), flush=True)
        held = cases[number].get("each", {}) | found.get("each", {})
        cases[number] |= found | ({"each": held} if held else {})
    return list(cases.values())


def figures(cases: list[dict]) -> dict:
    """How often the cause is named first: before, and after each round."""
    out = {"before": sum(c["before"]["right"] for c in cases)}
    for kind in ("advised", "random"):
        out[kind] = [sum(c[kind][r]["right"] for c in cases) for r in range(ROUNDS)]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--cases", type=int, default=len(CAUSES))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--each", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("closed_loop.json"))
    arguments = parser.parse_args()
    use_single_thread()
    numbers = list(range(arguments.first, arguments.first + arguments.cases))
    cases = study(numbers, arguments.jobs, arguments.each)
    command = "python -m experiments.diagnosis.closed_loop"
    command += f" --first {arguments.first} --cases {len(cases)}"
    command += " --each" if arguments.each else ""
    found = {"command": command, "of": len(cases), "right": figures(cases), "cases": cases}
    arguments.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

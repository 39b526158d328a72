"""What the diagnosis says of vehicles in wakes as they are felt: late, wandering, a few
cm wide.

    python -m experiments.diagnosis.wakes --cases 16 --jobs 16 --out wakes.json

A vehicle of the exam's plant flies twice under another one that passes 14 to 50 cm
above it, and once elsewhere. Of the other one's wake it feels a push of the usual form,
6 to 15 g at the rotors. But the wake falls at 2.5 m/s, so that it arrives when the
other vehicle is elsewhere, and wanders by 2 cm per 40 cm. Every other case has no wake,
but drag or wind: names that wakes were taken for.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, effects
from experiments.diagnosis.generate import in_processes
from experiments.flying.single_thread import use_single_thread

SEED = 503
COLUMN = "known"
CAUSES = ("downwash", "rotor_drag", "downwash", "wind")
STRENGTHS = (6.0, 15.0)  # g, of wakes
FALLS = 2.5  # m/s
WANDERS = 0.02  # m
PER = 0.4  # m
MEMORY = 0.25  # s
STEP = 0.002  # s


class Wakes:
    """Where the wakes seem to come from that vehicles feel now."""

    def __init__(self, count: int, rng: np.random.Generator):
        self.rng = rng
        self.aside = WANDERS * rng.standard_normal((2, count))
        self.columns = np.arange(count)
        self.past: list[np.ndarray] = []

    def __call__(self, below: np.ndarray, above: np.ndarray) -> np.ndarray:
        kept = np.exp(-STEP / MEMORY)
        drawn = self.rng.standard_normal(self.aside.shape)
        self.aside = kept * self.aside + WANDERS * np.sqrt(1.0 - kept**2) * drawn
        gap = np.clip(above[2] - below[2], 0.0, 1.0)
        self.past = [*self.past[-round(1.0 / FALLS / STEP) :], above.copy()]
        ago = np.minimum((gap / FALLS / STEP).astype(int), len(self.past) - 1)
        late = np.array(self.past)[-1 - ago, :, self.columns].T
        late[:2] += self.aside * gap / PER
        return late


def drawn(number: int) -> dict:
    """A case: one cause, and two flights under another vehicle."""
    effect = CAUSES[number % len(CAUSES)]
    names = list(effects.EFFECTS)
    turn = int(
        cases.case_rng(SEED, COLUMN, 0, 7, sorted(cases.SHARES).index("single")).integers(1000)
    )
    index = (names.index(effect) - turn) % len(names) + len(names) * number
    spec = cases.draw_case(SEED, COLUMN, number, "single", index)
    (cause,) = spec["causes"]
    low, high = STRENGTHS if effect == "downwash" else effects.EFFECTS[effect].sizes
    cause |= {"size": float(low * (high / low) ** 0.5), "form": effects.EFFECTS[effect].forms[0]}
    if effect == "downwash":
        cause["size"] = float(low + (high - low) * cause["shape"][7])
        cause["shape"][1] = 0.3 + 0.25 * cause["shape"][1]  # 4 to 6 cm wide
    return spec | {"missions": [("pass",) * 2, ("pass_moving",) * 2, spec["missions"][0]]}


def studied(number: int) -> dict:
    """Fly a case and diagnose it."""
    from experiments.diagnosis.fleet import Fleet, bodies, write_case
    from openjax.flights.case import load_case
    from openjax.gap.diagnosis import diagnose_case

    spec = drawn(number)
    flown = bodies(SEED, COLUMN, spec)
    wakes = Wakes(len(flown), np.random.default_rng([SEED, number]))
    fleet = Fleet(SEED, COLUMN, [(spec, spec["causes"])], {spec["name"]: flown}, wakes)
    with tempfile.TemporaryDirectory() as folder:
        write_case(fleet, 0, Path(folder) / spec["name"])
        case = load_case(Path(folder) / spec["name"])
    begin = time.process_time()
    report = diagnose_case(case)
    return {
        "number": number,
        "cause": spec["causes"][0]["effect"],
        "rate": spec["sensors"]["rate"],
        "magnitudes": fleet.magnitudes[0][0],
        "named": list(report.effects) or [report.verdict],
        "probabilities": {e: round(p, 3) for e, p in report.probabilities.items() if p > 0.03},
        "not_testable": "downwash" in report.not_testable,
        "parameters": {
            name: [v.value, *v.interval90]
            for name, v in report.parameters.get("downwash", {}).items()
        },
        "gusts": [text for text in report.sensors if "gusts" in text],
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


def figures(found: list[dict]) -> dict:
    """How often a wake is named or said to be not testable, and what is named beside
    it.
    """
    wakes = [c for c in found if c["cause"] == "downwash"]
    others = [c for c in found if c["cause"] != "downwash"]
    named = [c for c in wakes if "downwash" in c["named"]]
    silent = [c for c in wakes if c["not_testable"] and set(c["named"]) <= {"none", "not_testable"}]
    return {
        "wakes": len(wakes),
        "named": len(named),
        "not_testable_and_nothing_named": len(silent),
        "others": len(others),
        "others_first": sum(c["named"][0] == c["cause"] for c in others),
        "others_with_downwash": sum("downwash" in c["named"] for c in others),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cases", type=int, default=16)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("wakes.json"))
    options = parser.parse_args()
    use_single_thread()
    found = []
    numbers = list(range(options.first, options.first + options.cases))
    for case in in_processes(studied, numbers, options.jobs):
        print(json.dumps(case, default=float), flush=True)
        found.append(case)
    found.sort(key=lambda c: c["number"])
    command = "python -m experiments.diagnosis.wakes"
    command += f" --first {options.first} --cases {options.cases}"
    out = {"command": command, "figures": figures(found), "cases": found}
    options.out.write_text(json.dumps(out, indent=1, default=float) + "\n", encoding="utf-8")
    print(json.dumps(out["figures"]))


if __name__ == "__main__":
    main()

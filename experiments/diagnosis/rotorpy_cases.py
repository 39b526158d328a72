"""Cases flown in somebody else's simulator: RotorPy 3 (Folk, Paulos, Kumar 2023), the `dev` extra.

    python -m experiments.diagnosis.rotorpy_cases --seed 101 --each 4 --logs LOGS --answers
    ANSWERS.json [--jobs 8]

Rigid body, rotors, hub drag, parasitic drag, flapping moment, translational lift, motor lag, wind,
the controller (SE3Control, motor speeds at 250 Hz from the measured state) and the trajectories are
RotorPy's; the told vehicles, the sensors of the known column and the measure of severity are the
exam's. There are no body-rate commands. RotorPy's flapping coefficient is taken negative: with its
sign convention a positive one pitches the nose down in forward flight, against what flapping does.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, fleet, measure, sensors
from experiments.diagnosis import vehicle as v
from experiments.diagnosis.answer_key import HIDDEN, accepted
from experiments.diagnosis.firmware import SAMPLE
from experiments.diagnosis.generate import case_parser, in_processes, write_answers
from experiments.diagnosis.rotorpy_flights import SECONDS, fly, trajectory
from experiments.diagnosis.rotorpy_kinds import KINDS
from experiments.diagnosis.rows import log_rows
from experiments.flying.single_thread import use_single_thread

PATHS = ("circle", "eight", "rocking", "yawing")
LEAST = 4.0 / SAMPLE + 1  # samples that a flight must last


def make_case(job):
    """Fly and write one case; returns its answer."""
    seed, number, kind, folder = job
    rng = np.random.default_rng(np.random.SeedSequence([17, seed, number]))
    draw, effects, _, exposing = KINDS[kind]
    told = v.draw_told(rng)
    if "mass" in effects:  # a vehicle whose mass is the cause wasn't weighed
        told = replace(told, weighed=False)
    changed, wind, said = draw(rng, told, v.MAX_SPEED * np.sqrt(told.hover))
    np.random.seed(seed * 1000 + number)  # noqa: NPY002  RotorPy draws its motor noise from the global state
    needed = "pgm" if effects else "m"
    drawn = sensors.draw(rng, str(rng.choice(sensors.KINDS)), needed, "none")
    drawn["channels"] = drawn["channels"].replace("c", "")
    if "m" not in drawn["channels"]:
        drawn["channels"] += "m"
    drawn["rate"] = min(drawn["rate"], 500)
    nuisance = {"k_eta": told.thrust_constant * (1 + drawn["thrust_offset"])}
    # one trajectory that exposes the cause, where only some do, and others
    names = [str(rng.choice(exposing))] if exposing else []
    names += [str(n) for n in rng.choice(PATHS, 3 - len(names), replace=False)]
    ticks = int(SECONDS * 100)
    flights = []
    flown = []
    for name in names:
        for slower in (1.0, 0.7, 0.5, 0.35):  # some vehicles can't follow fast paths
            air = sensors.draw_air(rng, drawn, ticks, drawn["voltage"] + rng.uniform(-0.15, 0.1))
            flight = fly(told, nuisance | changed, wind, trajectory(name, rng, slower), drawn, air)
            if flight["crashed"][0] >= LEAST:
                break
        flown.append(flight)
        length = min(ticks, int(flight["crashed"][0]) // 5 - 5)
        flights.append([log_rows(rng, drawn, flight, 0, length)])
    joined = {k: np.concatenate([f[k] for f in flown], axis=-1) for k in flown[0]}
    place = Path(folder) / f"case_{number:03d}"
    fleet.write_logs(place, flights, drawn["channels"], v.toml(told, "RotorPy 3", drawn))
    return answer(place.name, kind, told, drawn, joined, flights, said)


def floor_of(told, drawn, joined, flights):
    """(seen, floor): mean squares (12,) of the told vehicle without a cause, and root mean squares
    of what air, sensors and the rows of the log leave to a true one.
    """
    many = [told] * 3
    none = np.zeros(3, bool)
    p = v.nominal_parameters(many)
    p["rotor_gain"] *= 1 + drawn["thrust_offset"]

    def errors(flown):
        return (measure.errors(flown, many, p, np.arange(3), none, none) ** 2).mean(axis=1)

    rows = [f[0] for f in flights]
    samples = len(joined["motor"])
    seen = errors(joined)
    sensed = np.array([measure.sensor_floor(drawn, r, joined, j) for j, r in enumerate(rows)])
    logged = np.stack([measure.motors_of_log(r, samples) for r in rows], axis=-1)
    lasts = np.minimum(joined["crashed"], [round(r["t"][-1] / SAMPLE) for r in rows])
    hidden = [errors(joined | {"motor": m, "crashed": lasts}) for m in logged]
    return seen, np.sqrt((sensed**2).mean(axis=0) + np.maximum(np.min(hidden, axis=0) - seen, 0.0))


def answer(name, kind, told, drawn, joined, flights, said):
    """The answer of one case; `said`: magnitudes of each effect."""
    _, effects, form, _ = KINDS[kind]
    seen, floor = floor_of(told, drawn, joined, flights)
    known = np.isfinite(floor)
    severity = float(np.sqrt(np.where(known, seen / floor**2, 0.0).max()))
    truth = [e if e != "unknown" else kind for e in effects]
    category = {0: "none", 1: "unknown" if effects == ["unknown"] else "single", 2: "pair"}[
        len(effects)
    ]
    if effects and severity < HIDDEN:
        category = "not_testable"
    forms, each = ([x] if isinstance(x, str | dict) else x for x in (form, said))
    causes = zip(truth, forms, each, strict=False)
    fine = ["wind", "rotor_drag"] if kind == "wind_tunnel" else []
    return {
        "case": name,
        "category": category,
        "effects": truth,
        "expected": ["none"] if category in ("none", "not_testable") else effects,
        "acceptable": {e: accepted(e, told.weighed) for e in effects if e != "unknown"},
        "also_fine": truth if category == "not_testable" else fine,
        "causes": [{"effect": e, "form": f, "magnitudes": m} for e, f, m in causes],
        "severity": cases.label(severity) if effects else None,
        "severity_ratio": round(severity, 3),
        "told": told.__dict__,
        "sensors": drawn,
        "rotorpy": kind,
    }


def main():
    parser = case_parser(__doc__)
    parser.add_argument("--each", type=int, default=4, help="cases of each kind")
    options = parser.parse_args()
    use_single_thread()
    kinds = [kind for kind in KINDS for _ in range(options.each)]
    order = np.random.default_rng(options.seed).permutation(len(kinds))
    jobs = [(options.seed, n, kinds[i], str(options.logs)) for n, i in enumerate(order, 1)]
    answers = sorted(in_processes(make_case, jobs, options.jobs), key=lambda a: a["case"])
    print("sha256", write_answers(options.answers, answers, options.seed, "rotorpy"))


if __name__ == "__main__":
    main()

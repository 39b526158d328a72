"""What cases flown in RotorPy share, whatever their vehicles know of themselves: plan, paths, files and answers."""

import multiprocessing
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, fleet, measure
from experiments.diagnosis import vehicle as v
from experiments.diagnosis.answer_key import HIDDEN, accepted
from experiments.diagnosis.generate import write_answers
from experiments.diagnosis.plant import SAMPLE
from experiments.flying.single_thread import use_single_thread


def fly_plan(options, kinds, make_case, column):
    """Fly the cases of `kinds` in an order drawn by the seed (or those of `--cases`), and write their answers."""
    use_single_thread()
    order = np.random.default_rng(options.seed).permutation(len(kinds))
    jobs = [(options.seed, n, kinds[i], str(options.logs)) for n, i in enumerate(order, 1)]
    if options.cases:
        jobs = [job for job in jobs if f"case_{job[1]:03d}" in options.cases.split(",")]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        answers = sorted(pool.imap_unordered(make_case, jobs), key=lambda a: a["case"])
    print("sha256", write_answers(options.answers, answers, options.seed, column))


def told_for(rng, effects):
    """The told vehicle of a case; one whose mass is the cause wasn't weighed."""
    told = v.draw_told(rng)
    return v.Told(**(told.__dict__ | {"weighed": False})) if "mass" in effects else told


def choose_paths(rng, exposing, paths):
    """Names of a case's three trajectories: one that exposes the cause, where only some do, and others."""
    names = [str(rng.choice(exposing))] if exposing else []
    return names + [str(n) for n in rng.choice(paths, 3 - len(names), replace=False)]


def slow_enough(attempt, enough):
    """The first flight of `attempt(slower)` that lasts `enough` samples, ever slower: some vehicles can't follow fast paths."""
    for slower in (1.0, 0.7, 0.5, 0.35):
        flight = attempt(slower)
        if flight["crashed"][0] >= enough:
            break
    return flight


def write_case(folder, number, flights, drawn, vehicle):
    """Write a case's three logs and its vehicle file; its folder."""
    place = Path(folder) / f"case_{number:03d}"
    place.mkdir(parents=True, exist_ok=True)
    for letter, flight in zip("abc", flights, strict=True):
        fleet.write_flight(place / f"flight_{letter}.csv.gz", flight, drawn["channels"])
    (place / "vehicle.toml").write_text(vehicle)
    return place


def answer(
    name, kind, told, drawn, names, joined, flights, effects, form, said, controller, fine, gusts=0.0, off=()
):
    """The answer of one case that was flown in RotorPy. `form`, `said`: of each effect where there are several; `fine`: names
    that are no mistake; `gusts` (12,): mean squares that the air adds to the channels of `measure`, part of the
    floor; `off` (5,): by how much motor time (a third of it), yaw torque and moments are off untold."""
    many, none = [told] * 3, np.zeros(3, bool)
    p = v.nominal_parameters(many)
    p["rotor_gain"] *= 1 + drawn["thrust_offset"]
    if len(off):
        for time in ("tau_up", "tau_down"):
            p[time] *= 1 + 3 * off[0]
        p["torque_ratio"] *= 1 + off[1]
        p["inertia"] *= 1 + np.diag(off[2:])[..., None]
    seen = (measure.errors(joined, many, p, np.arange(3), none, none) ** 2).mean(axis=1)
    floor = [measure.sensor_floor(drawn, f[0], joined, j) for j, f in enumerate(flights)]
    rows, samples = [f[0] for f in flights], len(joined["motor"])
    logged = np.stack([measure.motors_of_log(r, samples) for r in rows], axis=-1)
    lasts = np.minimum(joined["crashed"], [round(r["t"][-1] / SAMPLE) for r in rows])
    hidden = [
        (
            measure.errors(joined | {"motor": m, "crashed": lasts}, many, p, np.arange(3), none, none) ** 2
        ).mean(axis=1)
        for m in logged
    ]
    sensed = (np.array(floor) ** 2).mean(axis=0)
    floor = np.sqrt(sensed + gusts + np.maximum(np.min(hidden, axis=0) - seen, 0.0))
    known = np.isfinite(floor)
    energy = np.where(known, np.maximum(seen - gusts, 0.0) / floor**2, 0.0)
    severity, before = float(np.sqrt(energy.max())), float(np.sqrt(1 + energy[known].mean()))
    truth = [e if e != "unknown" else kind for e in effects]
    category = {0: "none", 1: "unknown" if effects == ["unknown"] else "single", 2: "pair"}[len(effects)]
    if effects and severity < HIDDEN:
        category = "not_testable"
    forms = [form] if isinstance(form, str) else list(form)
    each = said if isinstance(said, list) else [said]
    gone = before if category == "none" else 1.0
    return {
        "case": name,
        "category": category,
        "effects": truth,
        "expected": ["none"] if category in ("none", "not_testable") else effects,
        "acceptable": {e: accepted(e, told.weighed) for e in effects if e != "unknown"},
        "also_fine": truth if category == "not_testable" else fine,
        "causes": [
            {"effect": e, "form": f, "size": _size(e, m), "magnitudes": m}
            for e, f, m in zip(truth, forms, each, strict=False)
        ],
        "severity": cases.label(severity) if effects else None,
        "severity_ratio": round(severity, 3),
        "shares": {e: 1.0 for e in truth if len(truth) == 1 and category == "single"},
        "gap": {"before": before, "floor": gone, "closed_by_truth": 1 - gone / before},
        "mass_weighed": told.weighed,
        "told": told.__dict__,
        "controller": controller,
        "sensors": drawn,
        "missions": [[n] for n in names],
        "rotorpy": kind,
    }


def _size(effect, magnitudes):
    """How far a mass or thrust is off; the other causes need no size."""
    if effect == "mass":
        return abs(magnitudes["ratio"] - 1)
    return abs(magnitudes["scale"]) if effect == "thrust_scale" else 0.0

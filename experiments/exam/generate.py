"""Make cases of the exam: logs into one folder, answers into another file.

    python -m experiments.exam.generate --seed 1 --count 60 --logs OUT/logs --answers OUT/answers.json [--jobs 8]
    [--column stranger] [--only single,none]

Prints the SHA-256 of the answers. In one pass a case is flown with four sizes of its cause; the one whose gap, by
the plant's own measure, comes nearest to the severity drawn is kept.
"""

import argparse
import gzip
import hashlib
import json
import math
import multiprocessing
import os
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from experiments.exam import cases, effects, garbage, measure, plant, sensors, unknowns, vehicle  # noqa: E402

SIZES = 4
VOCABULARY = list(effects.EFFECTS)
LINK = ("command_latency", "packet_loss")  # effects that the commands in force tell
FIRMWARE = (*LINK, "rate_gains")
HIDDEN = 0.5  # floors; a cause that shows less can't be asked for
FORCE, TORQUE, YAW = slice(0, 3), slice(3, 5), 5  # channels of `measure`; TORQUE: roll and pitch


def bodies(seed, column, spec):
    """References, air and partners of a case's bodies, flight by flight."""
    rng = cases.case_rng(seed, column, spec["number"], 1)
    out, of_flight = [], []
    for mission in spec["missions"]:
        voltage = spec["sensors"]["voltage"] + rng.uniform(-0.15, 0.1)
        references = cases.reference_of(rng, mission, cases.TICKS)
        here = list(range(len(out), len(out) + len(references)))
        for i, reference in enumerate(references):
            air = sensors.draw_air(rng, spec["sensors"], cases.TICKS, voltage + rng.uniform(-0.02, 0.02))
            out.append((reference, air, here[::-1][i] if len(here) == 2 else here[i]))
        of_flight.append(here)
    return out, of_flight


def _write(cause, p, columns, arrival, strangers, count, rng):
    """Write one cause into the batch; returns its magnitudes."""
    name, size = cause["effect"], cause["size"]
    if name in effects.EFFECTS:
        return effects.apply(cause, p, columns, arrival, rng)
    if name == "gyro_scale":
        p["gyro_gain"][columns] = 1 + (size if cause["shape"][0] < 0.5 else -size)
    entry = strangers.setdefault(name, {"strength": np.zeros(count), "shape": np.zeros((8, count))})
    entry["strength"][columns] = size
    entry["shape"][:, columns] = np.asarray(cause["shape"])[:, None]
    return {"strength": size, "unit": cause["unit"]}


class Fleet:
    """Bodies of several variants of several cases, flown as one batch."""

    def __init__(self, seed, column, variants, drawn):
        """variants: list of (spec, causes); drawn: {case name: `bodies`}."""
        self.seed, self.column, self.variants = seed, column, variants
        told, references, airs, partner, kinds, self.columns = [], [], [], [], [], []
        for spec, _ in variants:
            start = len(told)
            for reference, air, other in drawn[spec["name"]][0]:
                told.append(spec["told"])
                references.append(reference)
                airs.append(air)
                partner.append(start + other)
                kinds.append(spec["controller"])
            self.columns.append(np.arange(start, len(told)))
        self.told, self.partner = told, np.array(partner)
        arrival = np.repeat(10 * np.arange(cases.TICKS)[:, None], len(told), axis=1)
        self.parameters, strangers, self.magnitudes = self.model([c for _, c in variants], arrival)
        reference = {k: np.stack([r[k] for r in references], axis=-1) for k in references[0]}
        self.flown = plant.fly(
            plant.Batch(
                told, self.parameters, reference, kinds, self.partner, arrival, sensors.stack(airs), strangers
            )
        )

    def model(self, causes_of, arrival=None):
        """Parameters with the nuisances and these causes; unknown causes and magnitudes beside."""
        p, strangers, magnitudes = vehicle.nominal_parameters(self.told), {}, []
        scratch = np.zeros((cases.TICKS, len(self.told)), int) if arrival is None else arrival
        for (spec, _), columns, own in zip(self.variants, self.columns, causes_of, strict=True):
            sensors.apply_nuisances(p, columns, spec["sensors"])
            said = []
            for i, cause in enumerate(own):
                rng = cases.case_rng(self.seed, self.column, spec["number"], 2, i)
                said.append(_write(cause, p, columns, scratch, strangers, len(self.told), rng))
            magnitudes.append(said)
        return p, strangers, magnitudes

    def errors(self, causes_of):
        """Mean squares (12, variants) of the model with these causes."""
        links, firmware = np.zeros((2, len(self.told)), bool)
        for (_, flew), columns, own in zip(self.variants, self.columns, causes_of, strict=True):
            links[columns] = any(c["effect"] in LINK for c in own)
            firmware[columns] = any(c["effect"] in FIRMWARE and c not in own for c in flew)
        known = [[c for c in own if c["effect"] in VOCABULARY] for own in causes_of]
        return self.errors_of(self.model(known)[0], firmware, links)

    def errors_of(self, parameters, firmware, links):
        """Mean squares (12, variants) of a model; see `measure.errors`."""
        rms = measure.errors(self.flown, self.told, parameters, self.partner, firmware, links)
        return np.stack([(rms[:, c] ** 2).mean(axis=1) for c in self.columns], axis=1)

    def replayed(self, i, parameters, motors=None, lasts=None):
        """Mean squares (12,) of a model on variant i alone, driven by other motor commands (S, 4, n) than it got, if given;
        `lasts` (n,): samples of them.
        """
        c, no = self.columns[i], np.zeros(len(self.columns[i]), bool)
        flown = {k: x[..., c] for k, x in self.flown.items()}
        if motors is not None:
            flown |= {"motor": motors, "crashed": np.minimum(flown["crashed"], lasts)}
        told, own = [self.told[j] for j in c], {k: x[..., c] for k, x in parameters.items()}
        return (measure.errors(flown, told, own, self.partner[c] - c[0], no, no) ** 2).mean(axis=1)

    def energies(self):
        """{model: mean squares (12, variants)}: the nominal model, the true one, and the true one without its first or
        second cause.
        """
        flew = [own for _, own in self.variants]
        out = {"nominal": self.errors([[] for _ in flew]), "truth": self.errors(flew)}
        if any(len(own) > 1 for own in flew):
            out |= {
                i: self.errors([[c for j, c in enumerate(own) if j != i] for own in flew]) for i in (0, 1)
            }
        return out

    def lasts(self, i):
        """Share of the longest flight that every body of variant i stays in the air."""
        return float(self.flown["crashed"][self.columns[i]].min() / (5 * cases.TICKS))

    def rows(self, i, spoiled=False):
        """The log of variant i: list over flights of lists over vehicles of {column: (n,)}, and the rows that are wrong."""
        spec, causes = self.variants[i]
        rng = cases.case_rng(self.seed, self.column, spec["number"], 3)
        sensed = {
            c["effect"]: (c["size"], c["shape"]) for c in causes if c["effect"] in unknowns.SENSOR_KINDS
        }
        out, j = [], self.columns[i][0]
        for mission, ticks in zip(spec["missions"], spec["ticks"], strict=True):
            bodies = range(j, j + (2 if len(mission) == 2 else 1))
            ticks = int(min([ticks] + [self.flown["crashed"][b] // 5 - 5 for b in bodies]))
            out.append([sensors.log_rows(rng, spec["sensors"], self.flown, b, ticks, sensed) for b in bodies])
            j = bodies[-1] + 1
        wrong = []
        if spoiled and spec["garbage"]:
            wrong = garbage.spoil(spec["garbage"], [f[0] for f in out], rng)
            wrong = [c for c in wrong if any(c in sensors.GROUPS[g] for g in spec["sensors"]["channels"])]
        return out, wrong


def write_flight(path, vehicles, channels):
    """One gzipped CSV file in the format of the flight logs; the same rows give the same bytes."""
    columns = [c for g in "psgacmv" if g in channels for c in sensors.GROUPS[g]]
    lines = []
    line = ",".join(f"%.{sensors.DECIMALS[c]}f" for c in columns)
    for i, rows in enumerate(vehicles):
        table = np.stack([rows[c] for c in columns], axis=1).tolist()
        times = rows["t"].tolist()
        lines += [(t, f"{t:.4f},{i}," + line % tuple(r)) for t, r in zip(times, table, strict=True)]
    lines.sort(key=lambda entry: entry[0])
    text = (
        ",".join(["t", "vehicle", *columns]) + "\n" + "\n".join(x for _, x in lines).replace("nan", "") + "\n"
    )
    with open(path, "wb") as raw, gzip.GzipFile("", "wb", 6, raw, mtime=0) as packed:
        packed.write(text.encode())


def write_case(fleet, i, folder, spoiled=False):
    """Write the logs and `vehicle.toml` of variant i into `folder`; returns its rows and the columns that were spoiled."""
    spec, (rows, wrong) = fleet.variants[i][0], fleet.rows(i, spoiled)
    folder.mkdir(parents=True, exist_ok=True)
    for letter, flight in zip("abc", rows, strict=True):
        write_flight(folder / f"flight_{letter}.csv.gz", flight, spec["sensors"]["channels"])
    (folder / "vehicle.toml").write_text(
        vehicle.toml(spec["told"], "simulated", spec["sensors"]["pose_rate"])
    )
    return rows, wrong


def _variants(spec):
    """The sets of causes that a case is flown with: {key: causes}."""
    if not spec["causes"]:
        return {"final": []}
    out = {"nominal": []} if spec["category"] == "unknown" else {}
    for i, cause in enumerate(spec["causes"]):
        low, high = (unknowns.ALL if spec["category"] == "unknown" else effects.EFFECTS)[
            cause["effect"]
        ].sizes
        for n in range(SIZES):
            place = (n + cause["shape"][7]) / SIZES
            out[i, n] = [cause | {"size": float(low * (high / low) ** place)}]
    return out


def _floors(fleet, i, turbulence):
    """Noise floor (12,) of a case from the logs of variant i and what turbulence leaves to the true model."""
    spec = fleet.variants[i][0]
    rows = [r for flight in fleet.rows(i)[0] for r in flight]
    each = [
        measure.sensor_floor(spec["sensors"], r, fleet.flown, j)
        for r, j in zip(rows, fleet.columns[i], strict=True)
    ]
    left = turbulence.copy()
    if "m" in spec["sensors"]["channels"]:
        samples, lasts = len(fleet.flown["motor"]), [round(r["t"][-1] / plant.SAMPLE) for r in rows]
        both = np.stack([measure.motors_of_log(r, samples) for r in rows], axis=-1)
        logged = np.min([fleet.replayed(i, fleet.parameters, m, np.array(lasts)) for m in both], axis=0)
        left[:6] = np.maximum(left[:6], logged[:6])
    return np.sqrt((np.array(each) ** 2).mean(axis=0) + left)


def _ratios(before, after, floor):
    return np.sqrt(np.maximum(before - after, 0.0)) / floor


def fly_chunk(job):
    """Fly, choose and write a list of cases; returns their answers."""
    seed, column, specs, folder = job
    drawn = {s["name"]: bodies(seed, column, s) for s in specs}
    tried = [(s, key, own) for s in specs for key, own in _variants(s).items()]
    first = Fleet(seed, column, [(s, own) for s, _, own in tried], drawn)
    energies = first.energies()
    nominal, truth = energies["nominal"], energies["truth"]
    place = {(s["name"], key): i for i, (s, key, _) in enumerate(tried)}
    floors, again, chosen = {}, [], {}
    for spec in specs:
        name, keys = spec["name"], [key for s, key, _ in tried if s is spec]
        base = place[name, keys[0]]
        floors[name] = floor = _floors(first, base, truth[:, base])
        if "final" in keys:
            chosen[name] = place[name, "final"]
            continue
        for i, cause in enumerate(spec["causes"]):
            options = []
            for n in range(SIZES):
                at = place[name, (i, n)]
                after = nominal[:, place[name, "nominal"]] if spec["category"] == "unknown" else truth[:, at]
                severity = max(float(_ratios(nominal[:, at], after, floor).max()), 1e-3)
                if cause["effect"] in unknowns.SENSOR_KINDS:  # the motion shows nothing: a middle size
                    severity = spec["targets"][i] * (1 + abs(n - 1.5))
                crash = 10 * (first.lasts(at) < 0.7)
                if spec["category"] == "not_testable":  # as large as stays hidden
                    options.append((crash + max(math.log(severity / HIDDEN), 0.0), -n, severity))
                else:
                    options.append((crash + abs(math.log(severity / spec["targets"][i])), n, severity))
            _, n, severity = min(options)
            n = abs(n)
            cause |= {"size": tried[place[name, (i, n)]][2][0]["size"], "alone": round(severity, 3)}
            chosen[name] = place[name, (i, n)]
            if first.lasts(chosen[name]) < 0.7:  # every size crashes: less of it
                cause["size"] *= 0.3
                again.append(spec)
        if len(spec["causes"]) > 1 and spec not in again:
            again.append(spec)
    second = Fleet(seed, column, [(s, s["causes"]) for s in again], drawn) if again else None
    energies_again = second.energies() if again else None
    answers = []
    for spec in specs:
        if spec in again:
            fleet, i, squares = second, again.index(spec), energies_again
        else:
            fleet, i, squares = first, chosen[spec["name"]], energies
        squares = {k: x[:, i] for k, x in squares.items()}
        if spec["category"] == "unknown":  # no model holds it: the same flights without it
            squares["truth"] = np.minimum(squares["nominal"], nominal[:, place[spec["name"], "nominal"]])
        answers.append(_answer(fleet, i, squares, floors[spec["name"]], folder, drawn[spec["name"]][1]))
    return answers


def _answer(fleet, i, squares, floor, folder, of_flight):
    """Write the logs of variant i and describe the case."""
    spec, own = fleet.variants[i]
    _, wrong = write_case(fleet, i, Path(folder) / spec["name"], spoiled=True)
    quiet = np.maximum(floor**2 - squares["truth"], 0.0)  # what the sensors add
    known = np.isfinite(floor)
    energy = {
        k: np.where(known, (x + np.where(known, quiet, 0.0)) / floor**2, 0.0) for k, x in squares.items()
    }
    names, shows = [c["effect"] for c in own], {}
    for j, name in enumerate(names):
        if name in VOCABULARY:
            energy[name] = energy[j] if len(own) > 1 else energy["nominal"]
            shows[name] = np.sqrt(np.maximum(energy[name] - energy["truth"], 0.0))
    energy = {k: e for k, e in energy.items() if isinstance(k, str)}
    excess = energy["nominal"] - energy["truth"]
    severity = float(np.sqrt(np.maximum(excess, 0)).max())
    if set(names) & set(unknowns.SENSOR_KINDS):
        seen = names  # the plant's measure reads no logs
    elif spec["category"] == "pair":
        seen = [n for n in names if shows[n].max() >= HIDDEN]
        severity = float(shows[seen[0]].max()) if len(seen) == 1 else severity
    else:
        seen = names if severity >= HIDDEN else []
    category = spec["category"]
    if category in ("single", "pair", "not_testable"):
        category = ("not_testable", "single", "pair")[len(seen)]
    elif category == "unknown" and not seen:
        category = "not_testable"
    names = [*seen, *(n for n in names if n not in seen)]
    total = max(float(excess.sum()), 1e-12)
    parts = [n for c in own for n in effects.PARTS.get((c["effect"], c["form"]), ())]
    magnitudes = [
        m
        | (
            {"logged_ms": sensors.pose_lag(m["delay_ms"], spec["sensors"])}
            if c["effect"] == "state_latency"
            else {}
        )
        for c, m in zip(own, fleet.magnitudes[i], strict=True)
    ]
    gap = {k: float(np.sqrt(energy[k][np.isfinite(floor)].mean())) for k in ("nominal", "truth")}
    expected = {"none": ["none"], "not_testable": ["none"], "unknown": ["unknown"], "garbage": ["garbage"]}
    told = {
        n: accepted(n, spec["told"].weighed, shows[n], _scale_stands_in(fleet, i, n, squares, floor))
        for n in shows
    }
    return {
        "case": spec["name"],
        "category": category,
        "effects": names or ([spec["garbage"]] if spec["garbage"] else []),
        "expected": expected.get(category, seen),
        "acceptable": told,
        "also_fine": spec["also_fine"] + parts + [n for n in names if n not in seen],
        "held_ms": 1e3 / spec["sensors"]["pose_rate"] if sensors.holds_poses(spec["sensors"]) else None,
        "in_sensors": bool(set(names) & set(unknowns.SENSOR_KINDS)),
        "causes": [c | {"magnitudes": m} for c, m in zip(own, magnitudes, strict=True)],
        "severity": cases.label(severity) if own else None,
        "severity_ratio": round(severity, 3),
        "shares": {
            n: round(float((energy[n] - energy["truth"]).sum() / total), 4) for n in names if n in energy
        },
        "energy": {k: [round(float(x), 4) for x in e] for k, e in energy.items()},
        "floor": {
            c: float(f"{f:.3g}") if np.isfinite(f) else None
            for c, f in zip(measure.CHANNELS, floor, strict=True)
        },
        "gap": {
            "before": gap["nominal"],
            "floor": gap["truth"],
            "closed_by_truth": 1 - gap["truth"] / gap["nominal"],
        },
        "wrong_columns": wrong,
        "mass_weighed": spec["told"].weighed,
        "told": spec["told"].__dict__,
        "controller": spec["controller"],
        "sensors": spec["sensors"],
        "missions": [list(m) for m in spec["missions"]],
        "two_vehicles": any(len(f) == 2 for f in of_flight),
    }


def _scale_stands_in(fleet, i, name, squares, floor):
    """Whether one constant factor on the thrust leaves less than `HIDDEN` floors of a cause in the map to thrust."""
    if name not in ("battery_sag", "thrust_curve"):
        return False
    own, c = fleet.variants[i][1], fleet.columns[i]
    others = [[k for k in causes if k["effect"] != name or causes is not own] for _, causes in fleet.variants]
    without = fleet.model(others)[0]
    some = slice(500, int(fleet.flown["crashed"][c].min()), 20)
    m, voltage, load = (fleet.flown[k][some][..., c].astype(float) for k in ("motor", "voltage", "load"))
    demands = []
    for p in (fleet.parameters, without):
        p = {k: x[..., c] for k, x in p.items()}
        active = effects.Active(p, vehicle.nominal_parameters([fleet.told[j] for j in c]))
        demands.append([effects.motor_demand(p, active, *now) for now in zip(m, voltage, load, strict=True)])
    true, plain = np.array(demands)
    without["rotor_gain"][:, c] *= (true * plain).sum() / (plain**2).sum()
    left = fleet.replayed(i, without)[FORCE] - squares["truth"][FORCE]
    return bool(np.sqrt(np.maximum(left, 0.0) / floor[FORCE] ** 2).max() < HIDDEN)


def accepted(name, weighed, shows=None, scale=False):
    """Names that are right for a cause: those that such flights can't tell apart from it.

    `shows` (12,): what the cause shows in each channel, in floors; `scale`: a constant factor on the thrust stands in.
    """
    shows = np.full(12, np.inf) if shows is None else shows
    out = [name]
    if scale:
        out.append("thrust_scale")
    if set(out) & {"mass", "thrust_scale"} and not weighed:
        out += [n for n in ("mass", "thrust_scale") if n not in out]
    if name == "yaw_torque" or (name == "inertia" and shows[TORQUE].max() < HIDDEN):
        out += ["inertia" if name == "yaw_torque" else "yaw_torque"]  # reaction torque and J_zz: one ratio
    if name == "blade_flapping" and shows[TORQUE].max() < HIDDEN:
        out.append("rotor_drag")  # only its torque tells it from drag
    if name == "motor_imbalance" and shows[YAW] < HIDDEN:
        out.append("com_offset")  # only its yaw trim tells it from an offset
    return out


def generate(seed, column, count, logs, jobs=1, only=None, chunk=8, progress=True, names=None):
    """All cases, or those of `names`; writes the logs and returns the answers, sorted by case."""
    specs = cases.draw_cases(seed, column, count, only)
    specs = [s for s in specs if names is None or s["name"] in names]
    size = max(1, min(chunk, math.ceil(len(specs) / jobs)))
    work = [(seed, column, specs[i : i + size], Path(logs)) for i in range(0, len(specs), size)]
    answers, start = [], time.perf_counter()

    def keep(part):
        answers.extend(part)
        if progress:
            print(f"{len(answers)}/{len(specs)} cases, {time.perf_counter() - start:.0f} s", flush=True)

    if jobs == 1:
        for job in work:
            keep(fly_chunk(job))
    else:
        with multiprocessing.get_context("spawn").Pool(min(jobs, len(work))) as pool:
            for part in pool.imap_unordered(fly_chunk, work):
                keep(part)
    return sorted(answers, key=lambda a: a["case"])


def write_answers(path, answers, seed, column, count=None):
    """Write the answers as JSON; returns the SHA-256 of the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(
        {
            "seed": seed,
            "count": count or len(answers),  # of the plan that these cases are of
            "column": column,
            "channels": measure.CHANNELS,
            "cases": {a["case"]: a for a in answers},
        },
        indent=1,
    )
    path.write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    path.with_suffix(".sha256").write_text(digest + "\n")
    return digest


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--column", choices=list(cases.COLUMN), default="known")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--only", help="categories, comma-separated: " + ", ".join(cases.SHARES))
    parser.add_argument("--cases", help="these cases of the plan alone, comma-separated: case_003,case_017")
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    if options.answers.resolve().is_relative_to(options.logs.resolve()):
        parser.error("--answers must not lie inside --logs")
    only = options.only.split(",") if options.only else None
    names = options.cases.split(",") if options.cases else None
    answers = generate(
        options.seed, options.column, options.count, options.logs, options.jobs, only, names=names
    )
    print("sha256", write_answers(options.answers, answers, options.seed, options.column, options.count))


if __name__ == "__main__":
    main()

"""The answer key: what the logs of a case can show, and so what is asked of a diagnosis. Rules:
README.md.
"""

import functools

import numpy as np

from experiments.diagnosis import cases, effects, forces, measure, sensors, unknowns, vehicle
from experiments.diagnosis.firmware import SAMPLE
from experiments.diagnosis.fleet import VOCABULARY

HIDDEN = 0.5  # floors; a cause that shows less can't be asked for
# channels of `measure`; TORQUE: roll and pitch
FORCE, TORQUE, YAW = slice(0, 3), slice(3, 5), 5


def floors(fleet, i, turbulence):
    """Noise floor (12,) of a case from the logs of variant i and what turbulence leaves to the true
    model.
    """
    spec = fleet.variants[i][0]
    rows = [r for flight in fleet.rows(i)[0] for r in flight]
    bodies = zip(rows, fleet.columns[i], strict=True)
    each = [measure.sensor_floor(spec["sensors"], r, fleet.flown, j) for r, j in bodies]
    left = turbulence.copy()
    if "m" in spec["sensors"]["channels"]:
        samples = len(fleet.flown["motor"])
        lasts = [round(r["t"][-1] / SAMPLE) for r in rows]
        both = np.stack([measure.motors_of_log(r, samples) for r in rows], axis=-1)
        logged = np.min(
            [fleet.replayed(i, fleet.parameters, m, np.array(lasts)) for m in both], axis=0
        )
        left[:6] = np.maximum(left[:6], logged[:6])
    return np.sqrt((np.array(each) ** 2).mean(axis=0) + left)


def answer_of(fleet, i, squares, floor, wrong):
    """The answer of variant i: what was put in, what of it shows, which names are right; `wrong`:
    spoiled columns.
    """
    spec, own = fleet.variants[i]
    known = np.isfinite(floor)
    quiet = np.where(
        known, np.maximum(floor**2 - squares["truth"], 0.0), 0.0
    )  # what the sensors add
    energy = {k: np.where(known, (x + quiet) / floor**2, 0.0) for k, x in squares.items()}
    names = [c["effect"] for c in own]
    shows = {}
    for j, name in enumerate(names):
        if name in VOCABULARY:
            energy[name] = energy[j] if len(own) > 1 else energy["nominal"]
            shows[name] = np.sqrt(np.maximum(energy[name] - energy["truth"], 0.0))
    energy = {k: e for k, e in energy.items() if isinstance(k, str)}
    excess = energy["nominal"] - energy["truth"]
    severity = float(np.sqrt(np.maximum(excess, 0)).max())
    if set(names) & set(unknowns.SENSOR_SITES):
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
    sums = {n: (energy[n] - energy["truth"]).sum() for n in names if n in energy}
    parts = [n for c in own for n in effects.PARTS.get((c["effect"], c["form"]), ())]
    causes = [c | {"magnitudes": dict(m)} for c, m in zip(own, fleet.magnitudes[i], strict=True)]
    for cause in causes:
        if cause["effect"] == "state_latency":
            said = cause["magnitudes"]
            said["logged_ms"] = sensors.pose_lag(said["delay_ms"], spec["sensors"])
    before, after = (float(np.sqrt(energy[k][known].mean())) for k in ("nominal", "truth"))
    said_floor = [float(f"{f:.3g}") if np.isfinite(f) else None for f in floor]
    expected = {
        "none": ["none"],
        "not_testable": ["none"],
        "unknown": ["unknown"],
        "garbage": ["garbage"],
    }
    weighed = spec["told"].weighed
    scale = functools.partial(scale_stands_in, fleet, i, squares=squares, floor=floor)
    return {
        "case": spec["name"],
        "category": category,
        "effects": names or ([spec["garbage"]] if spec["garbage"] else []),
        "expected": expected.get(category, seen),
        "acceptable": {n: accepted(n, weighed, shown, scale(n)) for n, shown in shows.items()},
        "also_fine": spec["also_fine"] + parts + [n for n in names if n not in seen],
        "held_ms": 1e3 / spec["sensors"]["pose_rate"]
        if sensors.holds_poses(spec["sensors"])
        else None,
        "in_sensors": bool(set(names) & set(unknowns.SENSOR_SITES)),
        "causes": causes,
        "severity": cases.label(severity) if own else None,
        "severity_ratio": round(severity, 3),
        "shares": {n: round(float(s / total), 4) for n, s in sums.items()},
        "energy": {k: [round(float(x), 4) for x in e] for k, e in energy.items()},
        "floor": dict(zip(measure.CHANNELS, said_floor, strict=True)),
        "gap": {"before": before, "floor": after, "closed_by_truth": 1 - after / before},
        "wrong_columns": wrong,
        "mass_weighed": weighed,
        "told": spec["told"].__dict__,
        "controller": spec["controller"],
        "sensors": spec["sensors"],
        "missions": [list(m) for m in spec["missions"]],
        "two_vehicles": any(len(m) == 2 for m in spec["missions"]),
    }


def scale_stands_in(fleet, i, name, squares, floor):
    """Whether one constant factor on the thrust leaves less than `HIDDEN` floors of a cause in the
    map to thrust.
    """
    if name not in ("battery_sag", "thrust_curve"):
        return False
    own = fleet.variants[i][1]
    c = fleet.columns[i]
    others = [
        [k for k in causes if k["effect"] != name or causes is not own]
        for _, causes in fleet.variants
    ]
    without = fleet.model(others)[0]
    some = slice(500, int(fleet.flown["crashed"][c].min()), 20)
    m, voltage, load = (
        fleet.flown[k][some][..., c].astype(float) for k in ("motor", "voltage", "load")
    )
    demands = []
    for p in (fleet.parameters, without):
        p = {k: x[..., c] for k, x in p.items()}
        active = forces.Active(p, vehicle.nominal_parameters([fleet.told[j] for j in c]))
        demands.append(
            [forces.motor_demand(p, active, *now) for now in zip(m, voltage, load, strict=True)]
        )
    true, plain = np.array(demands)
    # on the command, so that the rotors' speeds at the start of a window are those that flew
    without["curve_map"][1, c] *= (true * plain).sum() / (plain**2).sum()
    left = fleet.replayed(i, without)[FORCE] - squares["truth"][FORCE]
    return bool(np.sqrt(np.maximum(left, 0.0) / floor[FORCE] ** 2).max() < HIDDEN)


def accepted(name, weighed, shows=None, scale=False):
    """Names that are right for a cause: those that such flights can't tell apart from it.

    `shows` (12,): what the cause shows in each channel, in floors; `scale`: a constant factor on
    the thrust stands in.
    """
    shows = np.full(12, np.inf) if shows is None else shows
    out = [name]
    if scale:
        out.append("thrust_scale")
    if set(out) & {"mass", "thrust_scale"} and not weighed:
        out += [n for n in ("mass", "thrust_scale") if n not in out]
    if name == "yaw_torque" or (name == "inertia" and shows[TORQUE].max() < HIDDEN):
        out += [
            "inertia" if name == "yaw_torque" else "yaw_torque"
        ]  # reaction torque and J_zz: one ratio
    if name == "blade_flapping" and shows[TORQUE].max() < HIDDEN:
        out.append("rotor_drag")  # only its torque tells it from drag
    if name == "motor_imbalance" and shows[YAW] < HIDDEN:
        out.append("com_offset")  # only its yaw trim tells it from an offset
    return out

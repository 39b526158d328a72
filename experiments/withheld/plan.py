"""Which cases are drawn: how many of each kind, their causes, targets and missions. Everything follows from
the seed.

Tuning seeds are 1 to 99, reporting seeds 100 and above: no flight, magnitude or noise is shared between them.
"""

import math

import numpy as np

from experiments.withheld import cases, causes, unknowns

FULL = {"none": 200, "pair": 60, "unknown": 60, "left_out": 20, "not_testable": 20} | {
    e: 20 for e in causes.EFFECTS
}
# effects that can stand in for one another: not drawn as a pair, and left out of the library together
FAMILIES = (
    ("mass", "thrust_scale"),
    ("rotor_drag", "wind", "blade_flapping"),
    ("motor_imbalance", "com_offset"),
    ("inertia", "yaw_torque"),
    ("thrust_curve", "thrust_saturation", "battery_sag"),
    ("battery_sag", "thrust_scale", "mass"),
)
LEFT_OUT = {
    "mass": ["mass", "thrust_scale"],
    "thrust_scale": ["mass", "thrust_scale"],
    "battery_sag": ["battery_sag"],
    "thrust_saturation": ["thrust_saturation"],
    "rotor_drag": ["rotor_drag", "wind"],
    "blade_flapping": ["blade_flapping", "com_offset"],
    "wind": ["wind"],
    "ground_effect": ["ground_effect"],
    "ceiling_effect": ["ceiling_effect"],
    "downwash": ["downwash"],
    "motor_lag": ["motor_lag"],
    "command_latency": ["command_latency"],
    "packet_loss": ["packet_loss"],
    "thrust_curve": ["thrust_curve"],
    "motor_imbalance": ["motor_imbalance"],
    "com_offset": ["com_offset", "motor_imbalance"],
    "inertia": ["inertia"],
    "yaw_torque": ["yaw_torque", "inertia"],
    "rate_gains": ["rate_gains"],
    "state_latency": ["state_latency"],
}
# effect -> missions that do not show it; everything else about the vehicle is as in a testable case
BLIND = {
    "ground_effect": ("hover", "agile", "fast", "yaw", "high"),
    "ceiling_effect": ("hover", "fast", "yaw", "low"),
    "downwash": ("hover", "agile", "fast", "climb", "yaw", "step"),
    "thrust_saturation": ("hover",),
    "rotor_drag": ("hover",),
    "blade_flapping": ("hover",),
}


def counts(scale):
    """The full plan scaled; every kind keeps at least one case."""
    return {k: max(1, math.ceil(n * scale)) for k, n in FULL.items()}


def parse_counts(text):
    """ "none=4,each=1,pair=2" to counts; `each` stands for every effect."""
    out = {}
    for part in text.split(","):
        kind, _, number = part.partition("=")
        for name in causes.EFFECTS if kind.strip() == "each" else (kind.strip(),):
            if name not in FULL:
                raise SystemExit(f"--kinds: unknown kind {name!r}; known: {', '.join(FULL)}, each")
            out[name] = int(number or 1)
    return out


def _related(a, b):
    return a == b or any(a in f and b in f for f in FAMILIES)


def _target(rng, band):
    low, high = cases.BANDS[band]
    return float(low * (high / low) ** rng.uniform())


def _single(rng, effect, index, band=None):
    band = band or ("low", "medium", "high")[index % 3]
    return {
        "kind": "single",
        "effects": [effect],
        "causes": [causes.draw(rng, effect, causes.FORMS[effect][index // 3 % len(causes.FORMS[effect])])],
        "targets": [_target(rng, band)],
        "band": band,
        "needed": [causes.EXPOSING.get(effect, ())],
    }


def _pair(rng):
    while True:
        one, two = (str(e) for e in rng.choice(causes.EFFECTS, 2, replace=False))
        if not _related(one, two):
            break
    bands = [str(x) for x in rng.choice(["medium", "high"], 2)]
    return {
        "kind": "pair",
        "effects": [one, two],
        "causes": [causes.draw(rng, e) for e in (one, two)],
        "targets": [_target(rng, x) for x in bands],
        "band": "+".join(bands),
        "needed": [causes.EXPOSING.get(e, ()) for e in (one, two)],
    }


def _unknown(rng, index):
    kinds = list(unknowns.KINDS)
    name = kinds[index % len(kinds)]
    band = ("medium", "high")[(index // len(kinds)) % 2]
    cause = {"effect": name, "form": "outside", "size": 1.0, "shape": rng.uniform(0, 1, 8).tolist()}
    needed = {
        "wall_suction": ("fast",),
        "descent_loss": ("climb", "spiral"),
        "translational_lift": ("fast", "agile"),
        "rotor_precession": ("agile", "step", "yaw"),
        "roll_yaw_coupling": ("agile", "step"),
        "sticky_motor": ("agile", "climb"),
    }
    return {
        "kind": "unknown",
        "effects": ["unknown"],
        "causes": [cause],
        "targets": [_target(rng, band)],
        "band": band,
        "needed": [needed.get(name, ())],
    }


def _hidden(rng, index):
    effect = list(BLIND)[index % len(BLIND)]
    # a form that is really zero away from the surface: the others reach further
    cause = causes.draw(rng, effect, "exponential" if effect in ("ground_effect", "ceiling_effect") else None)
    smallest, start, largest = causes.LIMITS[effect]
    cause["size"] = float(np.clip(start * rng.uniform(0.7, 1.5), smallest, largest))
    two = effect == "downwash" and rng.random() < 0.5
    options = BLIND[effect]
    flights = [
        str(m)
        for m in (rng.choice(options, 3, replace=False) if len(options) >= 3 else rng.choice(options, 3))
    ]
    return {
        "kind": "not_testable",
        "effects": [],
        "causes": [cause],
        "targets": [None],
        "band": "hidden",
        "flights": [(f, str(rng.choice(options))) if two else (f,) for f in flights],
        "hidden": effect,
    }


def make_plan(seed, wanted):
    """List of case specs in a shuffled order, named case_0001 and so on."""
    specs = []
    for position, kind in enumerate(FULL):
        for index in range(wanted.get(kind, 0)):
            rng = cases.case_rng(seed, index, 100 + position)
            without = []
            if kind == "none":
                # the missions of some effect's cases, so that missions do not give the answer away
                like = causes.EFFECTS[int(rng.integers(len(causes.EFFECTS)))]
                spec = {
                    "kind": "none",
                    "effects": [],
                    "causes": [],
                    "targets": [],
                    "band": None,
                    "needed": [causes.EXPOSING.get(like, ())],
                }
            elif kind == "pair":
                spec = _pair(rng)
            elif kind == "unknown":
                spec = _unknown(rng, index)
            elif kind == "left_out":
                effect = causes.EFFECTS[index % len(causes.EFFECTS)]
                spec = _single(
                    rng, effect, int(rng.integers(12)), ("medium", "high")[index // len(causes.EFFECTS) % 2]
                )
                spec |= {"kind": "left_out", "effects": ["unknown"]}
                without = LEFT_OUT[effect]
            elif kind == "not_testable":
                spec = _hidden(rng, index)
            else:
                spec = _single(rng, kind, index)
            if "flights" not in spec:
                spec["flights"] = cases.draw_missions(rng, spec["needed"], rng.random() < 0.2)
            spec["without"] = without
            weighed = rng.random() < 0.2
            spec["mass_weighed"] = bool(weighed and "mass" not in [c["effect"] for c in spec["causes"]])
            specs.append(spec)
    order = cases.case_rng(seed, 0, 99).permutation(len(specs))
    out = []
    for number, i in enumerate(order, 1):
        out.append(specs[i] | {"number": number, "name": f"case_{number:04d}"})
    return out

"""Which cases are drawn. Everything follows from the seed, the column (`known` or `stranger`) and
the case's number.

The known column may be used for development at will, and the real one, the same on vehicles with
the errors of form that real ones have. The stranger's column draws sensors, a controller, vehicles,
unknown kinds and garbage that the others never draw; it is for reported runs only.
"""

from dataclasses import replace

import numpy as np

from experiments.diagnosis import (
    controllers,
    effects,
    garbage,
    missions,
    real,
    sensors,
    unknowns,
    vehicle,
)

SHARES = {
    "single": 0.50,
    "none": 0.14,
    "pair": 0.10,
    "unknown": 0.12,
    "not_testable": 0.06,
    "garbage": 0.08,
}
BANDS = {
    "low": (0.8, 1.6),
    "medium": (2.0, 4.0),
    "high": (5.0, 40.0),
}  # gap in noise floors, see `measure`
TICKS = 1000  # of 10 ms in a flight, at most
STYLES = {  # what a lab flies beside the flight that exposes the cause
    "excite": ("agile", "step", "yaw", "climb"),
    "laps": ("laps", "fast", "spiral", "climb"),
    "survey": ("hover", "climb", "low", "high", "laps"),
}
# effect -> missions that do not show it; everything else about the vehicle is as in a
# testable case
BLIND = {
    "ground_effect": ("hover", "agile", "fast", "yaw", "high"),
    "ceiling_effect": ("hover", "fast", "yaw", "low"),
    "downwash": ("hover", "agile", "fast", "climb", "yaw", "step"),
    "thrust_saturation": ("hover",),
    "rotor_drag": ("hover",),
    "motor_lag": ("hover",),
    "inertia": ("hover",),
    "rate_gains": ("hover",),
}
TIMED = ("command_latency", "packet_loss", "state_latency", "motor_lag")
COLUMN = {"known": 0, "stranger": 1, "real": 2}


def case_rng(seed, column, number, *more):
    """The random numbers of one case; columns and seeds share none."""
    return np.random.default_rng(np.random.SeedSequence([13, COLUMN[column], seed, number, *more]))


def label(severity):
    """Severity band of a gap in noise floors."""
    return (
        "hidden"
        if severity < 0.5
        else "low"
        if severity < 2.0
        else "medium"
        if severity < 4.5
        else "high"
    )


def _target(rng, band):
    low, high = BANDS[band]
    return float(low * (high / low) ** rng.uniform())


def draw_missions(rng, needed, style, two):
    """Three flights, each a mission or a pair of them; what is needed is flown twice if there is
    room.
    """
    flights = [str(rng.choice(options)) for options in needed * 2 if options][:3]
    while len(flights) < 3:
        rest = [m for m in STYLES[style] if m not in flights]
        flights.append(str(rng.choice(rest)))
    flights = [flights[i] for i in rng.permutation(3)]
    if not two and not any(f in missions.PAIR for f in flights):
        return [(f,) for f in flights]
    return [(f, f) if f in missions.PAIR else (f, str(rng.choice(STYLES[style]))) for f in flights]


def _kinds(column, known, strangers):
    return list(strangers) if column == "stranger" else list(known)


def draw_case(seed, column, number, category, index):
    """One case as a dict of plain values; `index` counts within the category, so that kinds come in
    turn.
    """
    rng = case_rng(seed, column, number)
    told = vehicle.draw_told(rng)
    wrong_form = None
    if column == "real" or (column == "stranger" and rng.random() < 0.5):
        told, wrong_form = real.draw(rng, column == "stranger")
    turn = int(case_rng(seed, column, 0, 7, sorted(SHARES).index(category)).integers(1000))
    names = list(effects.EFFECTS)
    causes = []
    targets = []
    needed = []
    channels = ""
    spoiled = None
    if category == "single":
        effect = names[(index + turn) % len(names)]
        causes = [effects.draw(rng, effect)]
        targets = [_target(rng, ("low", "medium", "high")[(index // len(names) + index) % 3])]
    elif category == "pair":
        while True:
            one, two = (str(e) for e in rng.choice(names, 2, replace=False))
            if not any(one in f and two in f for f in effects.FAMILIES):
                break
        causes = [effects.draw(rng, e) for e in (one, two)]
        targets = [float(2.0 * 6.0 ** rng.uniform()) for _ in causes]  # both matter
    elif category == "unknown":
        kinds = list(unknowns.SITES)
        kind = kinds[(index + turn) % len(kinds)]
        (low, high), unit, logs = unknowns.SITES[kind]
        form = unknowns.FORMS["stranger" if column == "stranger" else "known"]
        causes = [{"effect": kind, "form": form, "shape": rng.uniform(0, 1, 8).tolist()}]
        causes[0] |= {"size": float(low * (high / low) ** rng.uniform()), "unit": unit}
        targets = [_target(rng, str(rng.choice(["medium", "high"])))]
        needed = [unknowns.MISSIONS]
        channels = "pgmv" + logs
    elif category == "not_testable":
        effect = list(BLIND)[(index + turn) % len(BLIND)]
        # a form that is really zero away from the surface: the others reach further
        form = "exponential" if effect in ("ground_effect", "ceiling_effect") else None
        causes = [effects.draw(rng, effect, form)]
    elif category == "garbage":
        kinds = _kinds(column, garbage.KINDS, garbage.STRANGERS)
        spoiled = kinds[(index + turn) % len(kinds)]
        channels = (garbage.KINDS | garbage.STRANGERS)[spoiled]
    elif category == "none":
        # the missions of some effect's cases, so that missions do not give the answer
        # away
        needed = [effects.EFFECTS[str(rng.choice(names))].missions]
    if category in ("single", "pair"):
        needed = [effects.EFFECTS[c["effect"]].missions for c in causes]
        channels = "".join(effects.EFFECTS[c["effect"]].needs for c in causes)
    style = str(rng.choice(list(STYLES)))
    if category == "not_testable":
        effect = causes[0]["effect"]
        flights = [(str(rng.choice(BLIND[effect])),) for _ in range(3)]
        channels = effects.EFFECTS[effect].needs
    else:
        flights = draw_missions(rng, needed, style, rng.random() < 0.12 and category != "garbage")
    kind = str(rng.choice(_kinds(column, sensors.KINDS, sensors.STRANGERS)))
    if kind == "radio" and any(c["effect"] in TIMED for c in causes):
        kind = "filtered"  # clocks that wander by ten milliseconds can't time anything
    drawn = sensors.draw(rng, kind, channels)
    if "mass" in (c["effect"] for c in causes):
        told = replace(told, weighed=False)
    # 1000 rows a second make long files: the flights are shorter there
    most = TICKS if drawn["rate"] <= 250 else TICKS // 2 if drawn["rate"] <= 500 else TICKS * 2 // 5
    return {
        "name": f"case_{number:03d}",
        "number": number,
        "category": category,
        "causes": causes,
        "targets": targets,
        "also_fine": real.fine(wrong_form, [c["effect"] for c in causes]),
        "form_errors": wrong_form,
        "garbage": spoiled,
        "missions": flights,
        "style": style,
        "ticks": [int(rng.integers(8 * most // 10, most + 1)) for _ in flights],
        "controller": str(rng.choice(_kinds(column, controllers.KINDS, controllers.STRANGERS))),
        "sensors": drawn,
        "told": told,
    }


def draw_cases(seed, column, count, only=None):
    """A list of `count` cases in shuffled order, categories in the shares of `SHARES` (or those
    named in `only`).
    """
    shares = {k: w for k, w in SHARES.items() if not only or k in only}
    total = sum(shares.values())
    counts = {k: int(np.floor(count * w / total)) for k, w in shares.items()}
    counts[max(shares, key=shares.get)] += count - sum(counts.values())
    categories = [(k, i) for k, n in counts.items() for i in range(n)]
    order = case_rng(seed, column, 0).permutation(len(categories))
    return [draw_case(seed, column, n, *categories[i]) for n, i in enumerate(order, 1)]


def reference_of(rng, mission, ticks):
    """References of the one or two vehicles of a flight."""
    if mission[0] in missions.PAIR:
        return list(missions.pair(mission[0], rng, ticks))
    if len(mission) == 2:
        sides = zip(mission, (-1, 1), strict=True)
        return [missions.apart(missions.single(m, rng, ticks), side) for m, side in sides]
    return [missions.single(mission[0], rng, ticks)]

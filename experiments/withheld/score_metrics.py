"""The figures of the withheld check as plain functions of answers and predictions, and their 95 % intervals.

An answer is one entry of the answers file, a prediction one entry in the format of the sealed flights'
README: {"effects", "probabilities", "where", "reduction", "not_testable"}. Mass and thrust scale are one
class unless the vehicle was weighed.
"""

import numpy as np

from experiments.withheld.causes import EFFECTS

CLASSES = (*EFFECTS, "none", "unknown")


def wilson(hits, n, z=1.96):
    """95 % interval of a proportion (Wilson 1927); (0, 1) without data."""
    if n == 0:
        return 0.0, 1.0
    p = hits / n
    centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, float((centre - half) / (1 + z * z / n))), min(
        1.0, float((centre + half) / (1 + z * z / n))
    )


def share(flags):
    """{"value", "low", "high", "n"} of a list of booleans."""
    flags = [bool(f) for f in flags]
    low, high = wilson(sum(flags), len(flags))
    return {"value": sum(flags) / len(flags) if flags else None, "low": low, "high": high, "n": len(flags)}


def average(values, statistic=np.mean, rounds=2000):
    """Statistic of numbers with a bootstrap 95 % interval over cases."""
    values = np.asarray(values, float)
    if len(values) == 0:
        return {"value": None, "low": None, "high": None, "n": 0}
    rng = np.random.default_rng(0)
    drawn = values[rng.integers(0, len(values), (rounds, len(values)))]
    low, high = np.percentile(statistic(drawn, axis=1), [2.5, 97.5])
    return {"value": float(statistic(values)), "low": float(low), "high": float(high), "n": len(values)}


def merged(name, answer):
    """The class that stands for an effect in this case: mass and thrust scale cannot be told apart unless
    weighed.
    """
    return "thrust_scale" if name == "mass" and not answer["mass_weighed"] else name


def named(prediction, answer):
    """Effects named, best first, merged and without repeats; "unknown" stays."""
    return list(dict.fromkeys(merged(e, answer) for e in prediction["effects"]))


def first(prediction, answer):
    """The class that the prediction puts first: an effect, "unknown", or "none" when nothing is named."""
    effects = named(prediction, answer)
    return effects[0] if effects else "none"


def true_class(answer):
    """Class of the strongest cause: an effect, "none" or "unknown"."""
    if answer["kind"] in ("none", "not_testable"):
        return "none"
    if answer["kind"] in ("unknown", "left_out"):
        return "unknown"
    if answer["kind"] == "pair":
        strongest = max(answer["causes"], key=lambda c: c.get("severity_alone", 0.0))
        return merged(strongest["effect"], answer)
    return merged(answer["effects"][0], answer)


def probabilities(prediction, answer):
    """Probability per merged class."""
    out = dict.fromkeys(CLASSES, 0.0)
    for name, p in prediction["probabilities"].items():
        key = merged(name, answer)
        out[key] = out.get(key, 0.0) + float(p)
    return out


def in_first_two(prediction, answer):
    """The truth is what is put first, or among the two most probable classes."""
    truth = true_class(answer)
    p = probabilities(prediction, answer)
    return truth == first(prediction, answer) or truth in sorted(p, key=p.get, reverse=True)[:2]


def set_f1(prediction, answer):
    """F1 of the set of named effects against the true set; "unknown" counts as a wrong name."""
    said, true = set(named(prediction, answer)), {merged(e, answer) for e in answer["effects"]}
    both = len(said & true)
    return 2 * both / (len(said) + len(true)) if said or true else 1.0


def calibration(pairs, bins=10):
    """Expected calibration error of the most probable class, and the reliability diagram.

    pairs: list of (probability of the most probable class, whether it is the true one).
    """
    p, hit = np.array([a for a, _ in pairs], float), np.array([b for _, b in pairs], float)
    slot = np.minimum((p * bins).astype(int), bins - 1)
    rows, error = [], 0.0
    for i in range(bins):
        inside = slot == i
        if not inside.any():
            continue
        stated, seen = float(p[inside].mean()), float(hit[inside].mean())
        error += inside.mean() * abs(stated - seen)
        low, high = wilson(hit[inside].sum(), int(inside.sum()))
        rows.append({"stated": stated, "seen": seen, "low": low, "high": high, "n": int(inside.sum())})
    return float(error), rows


def calibration_interval(pairs, rounds=1000):
    """Expected calibration error with a bootstrap 95 % interval over cases."""
    if not pairs:
        return {"value": None, "low": None, "high": None, "n": 0}
    rng = np.random.default_rng(0)
    drawn = [
        calibration([pairs[i] for i in rng.integers(0, len(pairs), len(pairs))])[0] for _ in range(rounds)
    ]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return {"value": calibration(pairs)[0], "low": float(low), "high": float(high), "n": len(pairs)}


def top_pairs(cases):
    """(probability, right) of the most probable class, for (answer, prediction) pairs."""
    out = []
    for answer, prediction in cases:
        p = probabilities(prediction, answer)
        best = max(p, key=p.get)
        out.append((p[best], best == true_class(answer)))
    return out


# surface or wake that a flight must have passed for the effect to act; seconds of it are in the answers
PLACES = {
    "ground_effect": "below_15cm_s",
    "ceiling_effect": "within_15cm_of_ceiling_s",
    "downwash": "in_wake_s",
}


def not_testable_table(cases):
    """(listed, truly not testable) flags for every (case, effect) whose truth is plain.

    Plain are: the hidden effect of a not-testable case (not testable); the effects of a case of severity low
    or more (testable); floor, ceiling and wake where the flights never came near (not testable) or stayed two
    seconds and more (testable).
    """
    rows = []
    for answer, prediction in cases:
        listed, plain = set(prediction.get("not_testable") or []), {}
        for effect, key in PLACES.items():
            seconds = answer["exposure"][key]
            if seconds == 0 or seconds >= 2:
                plain[effect] = seconds == 0
        if answer["kind"] == "not_testable":
            plain[answer["hidden"]] = True
        elif answer["kind"] == "single" and answer["severity_ratio"] >= 0.8:
            plain[answer["effects"][0]] = False
        rows += [(effect in listed, truth) for effect, truth in plain.items()]
    return rows

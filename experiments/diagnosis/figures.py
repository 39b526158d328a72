"""Figures of a decision on tuning records, with the reporting check's own metrics."""

from types import SimpleNamespace

import numpy as np

from experiments.withheld import score_metrics as metrics
from experiments.withheld.score_parameters import TRUTH
from openjax.gap.diagnosis import robust_deviation
from openjax.gap.library import PLACE, path_of
from openjax.gap.linear_path import linear_score


def prediction_of(found, settings):
    """A decision in the format of a prediction."""
    unknown = found.unknown > settings.unknown_threshold
    extra = [e for e in found.best if path_of(e) != "physics"][:1]
    effects = ["unknown", *extra] if unknown else list(found.best)
    return {"effects": effects, "probabilities": found.probabilities, "not_testable": []}


def chance_of_truth(answer, probabilities):
    """Probability that was given to the true class."""
    return metrics.probabilities({"probabilities": probabilities}, answer)[metrics.true_class(answer)]


def top_pair(answer, probabilities):
    """(probability, whether right) of the most probable class."""
    return metrics.top_pairs([(answer, {"probabilities": probabilities})])[0]


def calibration_error(pairs, weight, bins=10):
    """Expected calibration error of weighed (probability, right) pairs."""
    p, hit = np.array(pairs, float).T
    slot, total = np.minimum((p * bins).astype(int), bins - 1), 0.0
    for i in np.unique(slot):
        own = weight * (slot == i)
        total += abs(np.sum(own * (p - hit)))
    return float(total / weight.sum())


# a row is (record, answer, prediction, decision)
def _right(row):
    return metrics.first(row[2], row[1]) == metrics.true_class(row[1])


def _says_unknown(row):
    return "unknown" in row[2]["effects"]


def _wrong(row):
    return len(row[2]["effects"]) > 0 and not _says_unknown(row)


def _exact(row):
    return metrics.set_f1(row[2], row[1]) == 1.0


def _rate(flags):
    return f"{np.mean(list(flags)):.3f}"


def show(judged, misses=False):
    """Print the figures of [(record, decision, settings)]."""
    rows = [(r, r["answer"], prediction_of(found, s), found) for r, found, s in judged]

    def pick(*kinds):
        return [row for row in rows if row[0]["kind"] in kinds and not row[0]["twin"]]

    single, none, pair = pick("single"), pick("none"), pick("pair")
    strong = [row for row in single if row[0]["severity"] >= 2.0]
    print(
        "top1", _rate(map(_right, single + none)), "top2", _rate(metrics.in_first_two(p, a) for _, a, p, _ in single + none),
        "strong", _rate(map(_right, strong)), "exact single", _rate(map(_exact, single)),
        "| pair f1", _rate(metrics.set_f1(p, a) for _, a, p, _ in pair), "exact", _rate(map(_exact, pair)),
        "| none alarm", _rate(bool(row[2]["effects"]) for row in none), "false unknown", _rate(map(_says_unknown, single)),
        "| silent", _rate(not row[2]["effects"] for row in pick("not_testable")),
    )  # fmt: skip
    twins = [row for row in rows if row[0]["twin"]]
    for name, group in (
        ("outside", pick("unknown")),
        ("left out", pick("left_out")),
        ("twins", twins),
        ("pairs", pair),
    ):
        if group:
            print(
                "  ",
                name,
                len(group),
                "unknown",
                _rate(map(_says_unknown, group)),
                "wrong name",
                _rate(map(_wrong, group)),
            )
    everything = [row for row in rows if not row[0]["twin"]]
    error, table = metrics.calibration(metrics.top_pairs([(a, p) for _, a, p, _ in everything]))
    print(
        "   calibration error",
        round(error, 3),
        [(round(b["stated"], 2), round(b["seen"], 2), b["n"]) for b in table],
    )
    classes = {}
    for row in single:
        classes.setdefault(row[0]["truth"][0], []).append(_right(row))
    print("  ", {k: f"{sum(v)}/{len(v)}" for k, v in classes.items()})
    if misses:
        for r, _, p, found in rows:
            fine = _says_unknown((r, _, p)) if r["kind"] in ("unknown", "left_out") else _exact((r, _, p))
            if fine or r["twin"]:
                continue
            causes = "+".join(f"{c['effect']}/{c['form']}" for c in r["answer"]["causes"])
            said = "+".join(p["effects"]) or "-"
            print(
                f"    {r['name']} {r['kind']} {causes} ({r['severity']:.1f}) -> {said} unknown {found.unknown:.2f}"
            )


def parameter_errors(records, other_paths=True):
    """{effect: [(error, standard deviation, size)]} of the true sets' fits and of the other paths, where truth has the
    library's form."""
    out = {}
    for r in records:
        if r["kind"] not in ("single", "pair"):
            continue
        physics = {e for e in r["truth"] if e in r["effects"] and path_of(e) == "physics"}
        fit = next((f for f in r["fits"] if set(f["effects"]) == physics), None)
        for cause in r["answer"]["causes"]:
            effect = cause["effect"]
            forms, truth_of, none = TRUTH.get(effect, ((), None, 0.0))
            if (
                fit is None
                or effect == "motor_imbalance"
                or effect not in physics
                or cause["form"] not in forms
            ):
                continue
            index = [int(i) for i in fit["index"]]
            plain = SimpleNamespace(
                covariance=np.array(fit["covariance"]), grams=np.array(fit["grams"]), index=np.array(index)
            )
            deviation = robust_deviation(plain)
            for name, value in truth_of(cause["magnitudes"]).items():
                at = index.index(PLACE[effect, name])
                out.setdefault(effect, []).append(
                    (fit["theta"][at] - value, deviation[at], fit["theta"][at] - none)
                )
    return out


def _other_path(record, effect, truth, none):
    """[(error, standard deviation, size)] of an effect of radio, rate loop or pose."""
    if effect == "state_latency" and record["pose"] is not None:
        _, theta, covariance = linear_score(np.array(record["pose"]).sum(0), np.array([0.02]))
        found, deviation = theta[0], np.sqrt(covariance[0, 0])
    elif effect == "rate_gains" and record["rate_loop"] is not None:
        _, theta, covariance = linear_score(np.array(record["rate_loop"]).sum(0), np.array([0.4] * 3))
        found, deviation = 1.0 + theta[0], np.sqrt(covariance[0, 0])
    elif effect in ("command_latency", "packet_loss") and record["radio"] is not None:
        radio = record["radio"]
        found = radio["delay" if effect == "command_latency" else "loss"]
        many = max(radio["informative"], 1)
        deviation = 5e-4 if effect == "command_latency" else np.sqrt(found * (1 - found) / many) + 0.5 / many
    else:
        return []
    return [(found - value, deviation, found - none) for value in list(truth.values())[:1]]

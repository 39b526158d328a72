"""Settle the numbers of the diagnosis' decision on tuning cases, and write `src/openjax/gap/decision.json`.

    python -m experiments.diagnosis.tune RECORDS.npz [...] [--earlier RECORDS.npz ...] [--last SEED ...] [--folds 4]
        [--write]

The records come from `experiments.diagnosis.records`; only the plant's tuning seeds (below 100) may be used. What
nominal flights show, how far effects explain what isn't theirs, temperatures and costs (log-probability of the true
set), the unknown gate (penalised logistic regression) and the intervals are settled on all seeds but `--last`; on those
the sharpness of the probabilities. `--folds` prints the figures on cases that took no part, fold by fold.
"""

import argparse
import dataclasses
import json
import zlib

import numpy as np
from scipy.optimize import minimize

from experiments.diagnosis import figures
from experiments.diagnosis.records import unpack
from experiments.withheld import plan
from openjax.gap import decision, gate
from openjax.gap.library import path_of
from openjax.gap.linear_path import linear_score

KNOWN = ("none", "single", "pair", "not_testable")
ROUNDS = 1
GRID = {
    "temperature": (1.5, 2.0, 3.0, 4.0, 6.0),
    "effect_cost": (0.0, 1.0, 2.0, 3.0),
    "second_cost": (4.0, 8.0, 12.0, 20.0, 30.0),
    "second_share": (0.002, 0.005, 0.01),
    "third_cost": (8.0, 20.0, 40.0, 80.0),
    "family_cost": (0.0, 2.0, 4.0, 8.0),
    "testable": (3.0, 6.0, 10.0),
    "rate_temperature": (1.5, 3.0, 5.0),
    "rate_cost": (1.0, 2.0, 3.0, 5.0),
    "cross_share": (0.0, 0.002, 0.005),
    "pose_temperature": (1.0, 1.5, 3.0),
    "pose_cost": (0.0, 2.0, 4.0),
    "radio_temperature": (5.0, 10.0, 20.0),
    "radio_cost": (4.0, 8.0, 12.0),
    "radio_both_cost": (0.0, 10.0, 20.0, 30.0),
    "least_loss": (0.003, 0.006, 0.01),
}
NULL_QUANTILE = 0.97
FORM_QUANTILES = (0.6, 0.75, 0.85, 0.95)
CLEAR_GAIN = 200.0  # nats from which a single cause says something about its form
LARGEST_SHARE = 0.4
FALSE_UNKNOWN = 0.035
RIDGE = 5.0  # precision of the unknown gate's standardised weights
TWIN = 0.4  # weight of a case read again with its effect left out
SIGNS = (
    "motion", "motion kept", "accelerometer", "predicted", "uneven", "sharp column", "sharp room", "column", "kept",
    "sharp kept", "sharp kept much", "sharper motion", "nuisances", "radio in vain", "pose in vain", "rate in vain",
    "gain", "size", "named", "flat curve",
)  # fmt: skip
FORM_PRIOR = 2  # cases with the usual error that an effect's own are pooled with
COVERAGE = 0.9


def load(files):
    """Records of several files, scores keyed by tuples; readings that failed are left out."""
    records = []
    for file in files:
        for name, record in unpack(file).items():
            if "error" in record:
                print(f"{name}: {record['error']}")
                continue
            if int(name.split("/")[0]) >= 100:
                raise SystemExit(f"{file}: seed {name.split('/')[0]} is for reporting, not for tuning")
            paths, answer = record["paths"], record["answer"]
            paths["sets"] = {tuple(k): v for k, v in paths["sets"]}
            if paths["radio"] is not None:
                paths["radio"] = ({tuple(k): v for k, v in paths["radio"][0]}, paths["radio"][1])
            for fit in record["fits"]:
                fit["effects"] = tuple(fit["effects"])
            # As the decision reads them now.
            if record["rate_loop"] is not None:
                score = linear_score(np.array(record["rate_loop"]).sum(0), np.array([0.4, 0.4, 0.4]))
                paths["rate"] = decision.rate_score(score)
            curve = next((f for f in record["fits"] if f["effects"] == ("thrust_curve",)), None)
            paths["flat"] = curve is not None and decision.flat(*curve["theta"][:3])
            records.append(
                record
                | {
                    "name": name, "kind": answer["kind"], "twin": bool(answer.get("twin")), "truth": answer["effects"],
                    "severity": answer["severity_ratio"], "seed": int(name.split("/")[0]),
                }
            )  # fmt: skip
    return records


def merged(effects):
    return frozenset(decision.SAME.get(e, e) for e in effects)


def null_of(records):
    """`gate.Null` of the nominal cases."""
    none = [r for r in records if r["kind"] == "none"]
    rest = np.array([r["left"][""]["rest"] for r in none])
    gains = {}
    for r in none:
        left = r["left"][""]
        own = gate.column_gains(np.array(left["push"]), np.array(left["weight"]), np.array(r["group"]))
        for name, values in zip(r["columns"], own.T, strict=True):
            gains.setdefault(name, []).append(values)
    columns = {
        k: tuple(np.maximum(np.quantile(v, 0.9, 0), 0).round(1).tolist())
        for k, v in gains.items()
        if len(v) > 4
    }
    inside = np.mean([r["left"][""]["inside"] for r in none], 0)
    sharper = np.mean([r["left"][""]["sharper"] for r in none], 0)
    return gate.Null(
        tuple(rest.mean(0).round(4).tolist()), tuple(np.maximum(rest.std(0), 0.03).round(4).tolist()), columns,
        tuple(tuple(row) for row in inside.round(1).tolist()), tuple(sharper.round(1).tolist()),
    )  # fmt: skip


def null_gains(records):
    """Nats that each effect gains where nothing acts."""
    gains = {}
    for r in records:
        if r["kind"] == "none":
            for key, value in r["paths"]["sets"].items():
                if len(key) == 1:
                    gains.setdefault(key[0], []).append(value)
    found = {e: float(np.quantile(v, NULL_QUANTILE)) for e, v in gains.items() if len(v) >= 5}
    return {e: round(v, 1) for e, v in found.items() if v > 0}


def form_shares(records, null_gain, quantile, least):
    """Share of its own gain that the best other effect adds to a true one, by effect."""
    shares = {}
    for r in records:
        if r["kind"] != "single" or path_of(r["truth"][0]) != "physics":
            continue
        effect, sets = r["truth"][0], r["paths"]["sets"]
        own = sets.get((effect,), 0.0)
        if own < CLEAR_GAIN:
            continue
        extra = [
            v - own - 10.0 - sum(null_gain.get(e, 0.0) for e in k if e != effect)
            for k, v in sets.items() if len(k) == 2 and effect in k and merged(k) != merged((effect,))
        ]  # fmt: skip
        shares.setdefault(effect, []).append(max(max(extra, default=0.0), 0.0) / own)
    return {
        e: round(float(np.clip(np.quantile([*v, 0.0, 0.01], quantile), least, LARGEST_SHARE)), 4)
        for e, v in shares.items()
    }


def chance(record, settings):
    """Probability of the true set of effects, given that it is in the library."""
    found = decision.decide_from(record["paths"], set(record["effects"]), None, settings)
    truth = merged(record["truth"]) if record["kind"] in ("single", "pair") else frozenset()
    return sum(p for k, p in found.posterior.items() if merged(k) == truth)


def loss_of(records, settings):
    """Mean negative log-probability of the true sets, floored so that hopeless cases don't rule."""
    weights = [2.0 if r["kind"] == "pair" else 1.0 for r in records]
    return np.average([-np.log(max(chance(r, settings), 0.02)) for r in records], weights=weights)


def settle_scores(records, settings, more=()):
    """Temperatures and costs, one after the other over their grid."""
    known = [r for r in records if r["kind"] in KNOWN]
    loss = loss_of(known, settings)
    for _ in range(ROUNDS):
        for quantile in FORM_QUANTILES:
            shares = form_shares([*records, *more], settings.null_gain, quantile, settings.second_share)
            tried = dataclasses.replace(settings, form_share=shares)
            if (new := loss_of(known, tried)) < loss - 1e-3:
                loss, settings = new, tried
        for name, values in GRID.items():
            for value in values:
                tried = dataclasses.replace(settings, **{name: value})
                if (new := loss_of(known, tried)) < loss - 1e-3:
                    loss, settings = new, tried
    return settings, loss


def signs_of(record, settings):
    """The gate's signs of a record about the set that the settings choose; about a near one if that wasn't kept."""
    found = decision.decide_from(record["paths"], set(record["effects"]), None, settings)
    physics = [e for e in record["paths"]["exposure"] if e in found.best]
    left = record["left"].get("+".join(physics))
    if left is None:
        near = max(
            record["left"],
            key=lambda k: 2 * len(set(k.split("+")) & set(physics)) - len(k.split("+")) * (k != ""),
        )
        left = record["left"][near]

    def plain(entry):
        room = {k: entry[k] for k in ("push", "weight", "inside", "power", "sharper")}
        return gate.Left(
            entry["rest"], room | {"names": record["columns"], "group": record["group"]}, entry["nuisances"]
        )

    nothing = plain(record["left"][""])
    return gate.features(plain(left), nothing, record["paths"], record["effects"], found.best, settings.null)


def settle_gate(records, settings):
    """The unknown gate by penalised logistic regression; its threshold where few known causes pass."""
    table = [signs_of(r, settings) for r in records]
    x = np.array([[t[k] for k in SIGNS] for t in table])
    y = np.array([r["kind"] in ("unknown", "left_out") for r in records], float)
    weight = np.array([TWIN if r["twin"] else 1.0 for r in records])
    centre, scale = x.mean(0), x.std(0) + 1e-3
    z = (x - centre) / scale

    def cost(w):
        s = w[0] + z @ w[1:]
        p = 1.0 / (1.0 + np.exp(-s))
        slope = np.r_[np.sum(weight * (p - y)), z.T @ (weight * (p - y)) + RIDGE * w[1:]]
        return np.sum(weight * (np.logaddexp(0, s) - y * s)) + 0.5 * RIDGE * np.sum(w[1:] ** 2), slope

    w = minimize(cost, np.zeros(1 + z.shape[1]), jac=True, method="L-BFGS-B").x
    unknown = {
        k: (round(float(c), 4), round(float(d), 4), round(float(v), 4))
        for k, c, d, v in zip(SIGNS, centre, scale, w[1:], strict=True)
    }
    settings = dataclasses.replace(settings, unknown=unknown, unknown_bias=round(float(w[0]), 4))
    passing = [
        decision.unknown_probability(t, settings)
        for t, r in zip(table, records, strict=True)
        if r["kind"] in ("none", "single")
    ]
    threshold = float(np.clip(np.quantile(passing, 1.0 - FALSE_UNKNOWN), 0.2, 0.8))
    return dataclasses.replace(settings, unknown_threshold=round(threshold, 3))


def settle_sharpness(records, settings):
    """Sharpness, the gate's own and the doubt, by the log-probability of the true class and the calibration error, cases
    weighed as the full plan mixes their kinds."""
    records = [r for r in records if not r["twin"]]
    known = [
        (r, signs_of(r, settings), decision.combine(r["paths"], set(r["effects"]), settings)) for r in records
    ]
    wanted = {k: plan.FULL[k] for k in ("none", "pair", "unknown", "left_out", "not_testable")}
    wanted["single"] = sum(plan.FULL.values()) - sum(wanted.values())
    count = {k: sum(r["kind"] == k for r in records) for k in wanted}
    weight = np.array([wanted[r["kind"]] / count[r["kind"]] for r in records])

    def tried(s, g, doubt):
        scaled = {k: (c, d, round(w * g, 5)) for k, (c, d, w) in settings.unknown.items()}
        bias = round(settings.unknown_bias * g, 4)
        return dataclasses.replace(settings, sharpness=s, doubt=doubt, unknown=scaled, unknown_bias=bias)

    def loss(s, g, doubt):
        changed, total, pairs = tried(s, g, doubt), [], []
        for r, signs, logs in known:
            found = decision.decide_from(r["paths"], set(r["effects"]), signs, changed, logs)
            total.append(-np.log(max(figures.chance_of_truth(r["answer"], found.probabilities), 0.005)))
            pairs.append(figures.top_pair(r["answer"], found.probabilities))
        error = figures.calibration_error(pairs, weight)
        return float(np.average(total, weights=weight)) + 2.0 * error, error

    best = min(
        (*loss(s, g, d), s, g, d) for s in (0.5, 0.75, 1.0) for g in (0.8, 1.0) for d in (0.0, 0.03, 0.06)
    )
    print("loss, calibration error, sharpness, gate, doubt:", [round(v, 3) for v in best])
    changed = tried(*best[2:])
    # The threshold means the same odds as before.
    odds = np.log(settings.unknown_threshold / (1 - settings.unknown_threshold)) * best[3]
    return dataclasses.replace(changed, unknown_threshold=round(float(1 / (1 + np.exp(-odds))), 3))


def settle_intervals(records, settings, more=()):
    """Share of an effect's size that its parameters may be off by, so that 90 % intervals hold so often. `more`:
    records of earlier readings, for their fits only."""
    errors = figures.parameter_errors(records)  # {effect: [(error, deviation, size)]}
    for effect, own in figures.parameter_errors(more, other_paths=False).items():
        errors.setdefault(effect, []).extend(own)
    alone = {e: _share(own) for e, own in errors.items()}
    usual = float(np.median(list(alone.values())))
    found = {}
    for effect, own in errors.items():
        pooled = own + [(usual * 1.645 * size, 0.0, size) for _, _, size in own[:FORM_PRIOR]]
        found[effect] = round(_share(pooled), 3)
    print("intervals:", {e: (round(alone[e], 3), len(errors[e])) for e in alone})
    return dataclasses.replace(settings, form_error=found, usual_form_error=round(usual, 3))


def _share(rows):
    if not rows:
        return 0.05
    error, deviation, size = np.array(rows).T
    for share in np.geomspace(0.003, 1.5, 80):
        if np.mean(np.abs(error) < 1.645 * np.hypot(deviation, share * np.abs(size))) >= COVERAGE:
            return float(share)
    return 1.5


def settle(records, last, more=(), settings=None):
    """All settings, from records and those of the last seeds."""
    settings = settings or decision.Settings(
        temperature=3.0,
        rate_cost=3.0,
        pose_temperature=1.5,
        radio_both_cost=20.0,
        second_cost=12.0,
        third_cost=20.0,
    )
    gains = null_gains(records)
    settings = dataclasses.replace(settings, null=null_of(records), null_gain=gains)
    settings = dataclasses.replace(
        settings, form_share=form_shares(records, gains, 0.75, settings.second_share)
    )
    settings, loss = settle_scores(records, settings, [r for r in more if r["kind"] == "single"])
    print(f"loss {loss:.3f}")
    settings = settle_gate(records, settings)
    settings = settle_intervals([*records, *(last or ())], settings, more)
    return settle_sharpness(last or records, settings)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+")
    parser.add_argument("--last", type=int, nargs="*", default=[])
    parser.add_argument(
        "--earlier", nargs="*", default=[], help="records of earlier readings: singles and their fits only"
    )
    parser.add_argument("--folds", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    records = load(options.files)
    if options.folds:
        fold = np.array(
            [zlib.crc32(r["name"].replace("/left_out", "").encode()) % options.folds for r in records]
        )
        judged = []
        for k in range(options.folds):
            train = [r for r, f in zip(records, fold, strict=True) if f != k]
            settings = settle(train, None)
            judged += [(r, decision.decide_from(r["paths"], set(r["effects"]), signs_of(r, settings), settings), settings)
                       for r, f in zip(records, fold, strict=True) if f == k]  # fmt: skip
        print("on cases that took no part:")
        figures.show(judged)
    first = [r for r in records if r["seed"] not in options.last]
    settings = settle(first, [r for r in records if r["seed"] in options.last], load(options.earlier))
    settings = dataclasses.replace(
        settings, notes=f"tuned by experiments/diagnosis/tune.py on {len(records)} readings of tuning seeds "
        f"{sorted({r['seed'] for r in records})}",
    )  # fmt: skip
    judged = [
        (r, decision.decide_from(r["paths"], set(r["effects"]), signs_of(r, settings), settings), settings)
        for r in records
    ]
    print("on the cases themselves:")
    figures.show(judged, misses=True)
    for sign, (_, _, w) in sorted(settings.unknown.items(), key=lambda kv: -abs(kv[1][2])):
        print(f"  {sign}: {w:+.2f}")
    print({k: v for k, v in dataclasses.asdict(settings).items() if k not in ("null", "unknown")})
    if options.write:
        decision.SETTINGS_FILE.write_text(json.dumps(dataclasses.asdict(settings), indent=1) + "\n")


if __name__ == "__main__":
    main()

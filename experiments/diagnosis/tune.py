"""Settle the numbers of the diagnosis' decision on tuning cases, and write `src/openjax/gap/decision.json`.

    python -m experiments.diagnosis.tune read --logs LOGS --answers ANSWERS.json --records RECORDS.json
    python -m experiments.diagnosis.tune fit RECORDS.json [RECORDS.json ...]

`read` reduces every case to the numbers that the decision sees (minutes); `fit` chooses temperatures and costs by the
log-probability of the true causes, the unknown gate by penalised logistic regression, both with the cases as the unit.
Only the plant's tuning seeds (below 100) may be used.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from openjax.gap import decision
from openjax.gap.case import load_case
from openjax.gap.evidence import gather
from openjax.gap.hypotheses import SetFit
from openjax.gap.library import library
from openjax.gap.rest import look

# Values tried for each number of the decision, in turn and in rounds.
ROUNDS = 3
GRID = {
    "temperature": (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0),
    "effect_cost": (-1.0, 0.0, 1.5, 3.0, 5.0),
    "second_share": (0.0, 0.002, 0.005, 0.01, 0.02, 0.04),
    "second_root": (0.0, 0.3, 0.6, 1.0, 1.5, 2.5),
    "second_cost": (0.0, 2.0, 4.0, 8.0),
    "family_cost": (0.0, 5.0, 12.0, 25.0, 60.0),
    "testable": (3.0, 6.0, 10.0, 20.0),
    "rate_temperature": (1.5, 3.0, 5.0, 8.0),
    "rate_cost": (0.0, 2.0, 5.0, 10.0),
    "cross_share": (0.0, 0.005, 0.02),
    "pose_temperature": (1.0, 1.5, 3.0),
    "pose_cost": (0.0, 2.0, 4.0),
    "radio_temperature": (3.0, 10.0, 30.0),
    "radio_cost": (3.0, 8.0, 15.0),
    "least_loss": (0.003, 0.006, 0.01),
}
FALSE_UNKNOWN = 0.03
RIDGE = 0.3  # precision of the unknown gate's standardised weights


def read(options):
    """Record of each case: scores by path, looks at the rest, truth."""
    answers = json.loads(options.answers.read_text())
    if answers["seed"] >= 100:
        raise SystemExit(f"{options.answers}: seed {answers['seed']} is for reporting, not for tuning")
    without = json.loads((options.logs / "without.json").read_text())
    done = json.loads(options.records.read_text()) if options.records.exists() else {}
    for name, answer in sorted(answers["cases"].items()):
        if name in done or int(name[-4:]) % options.parts != options.part:
            continue
        evidence = gather(load_case(options.logs / name), library(without.get(name, ())))
        best = max((f for f in evidence.sets.values() if isinstance(f, SetFit)), key=lambda f: f.score)
        paths = decision.path_scores(evidence)
        paths["sets"] = [[list(k), float(v)] for k, v in paths["sets"].items()]
        if paths["radio"] is not None:
            gain, loss = paths["radio"]
            paths["radio"] = [[[list(k), float(v)] for k, v in gain.items()], float(loss)]
        done[name] = {
            "kind": answer["kind"], "truth": answer["effects"], "severity": answer["severity_ratio"],
            "causes": [f"{c['effect']}/{c['form']}/{c['size']:.3g}" for c in answer["causes"]],
            "paths": paths, "effects": list(evidence.library.effects),
            "rest": look(evidence.replay, best).vector().tolist(), "seconds": evidence.seconds,
        }  # fmt: skip
        options.records.write_text(json.dumps(done))
        print(
            name,
            answer["kind"],
            best.effects,
            {k: round(v, 1) for k, v in evidence.seconds.items()},
            flush=True,
        )


def load(files):
    """Records of several files, scores keyed by tuples again."""
    records = []
    for number, file in enumerate(files):
        for name, record in json.loads(Path(file).read_text()).items():
            paths = record["paths"]
            paths["sets"] = {tuple(k): v for k, v in paths["sets"]}
            if paths["radio"] is not None:
                paths["radio"] = ({tuple(k): v for k, v in paths["radio"][0]}, paths["radio"][1])
            records.append(record | {"name": f"{number}/{name}"})
    return records


def _loss(records, settings):
    """Mean negative log-probability of the true sets, floored so that hopeless cases don't rule."""
    return -np.mean([np.log(max(true_probability(r, settings)[0], 0.02)) for r in records])


def merged(effects):
    return frozenset(decision.SAME.get(e, e) for e in effects)


def true_probability(record, settings):
    """Probability of the true set of effects, given that it is in the library."""
    found = decision.decide_from(record["paths"], set(record["effects"]), None, settings)
    truth = merged(record["truth"])
    return sum(p for k, p in found.posterior.items() if merged(k) == truth), found


def fit(options):
    """Choose the settings and write them."""
    records = load(options.files)
    known = [r for r in records if r["kind"] in ("none", "single", "pair", "not_testable")]
    settings = decision.Settings()
    loss = _loss(known, settings)
    for _ in range(ROUNDS):
        for name, values in GRID.items():
            for value in values:
                tried = dataclasses.replace(settings, **{name: value})
                if (new := _loss(known, tried)) < loss - 1e-4:
                    loss, settings = new, tried
    none = np.array([r["rest"] for r in records if r["kind"] == "none"])
    settings = dataclasses.replace(
        settings, rest_mean=tuple(none.mean(0).round(4).tolist()),
        rest_scale=tuple(np.maximum(none.std(0), 0.03).round(4).tolist()),
    )  # fmt: skip
    x = np.array(
        [decision.unknown_features(r["rest"], r["paths"], set(r["effects"]), settings) for r in records]
    )
    y = np.array([r["kind"] in ("unknown", "left_out") for r in records], float)
    centre, scale = x.mean(0), x.std(0) + 1e-9
    z = (x - centre) / scale

    def cost(w):
        s = w[0] + z @ w[1:]
        return np.sum(np.logaddexp(0, s) - y * s) + 0.5 * RIDGE * np.sum(w[1:] ** 2)

    w = minimize(cost, np.zeros(1 + z.shape[1]), method="BFGS").x
    settings = dataclasses.replace(
        settings, unknown_weights=tuple((w[1:] / scale).round(4).tolist()),
        unknown_bias=round(float(w[0] - (w[1:] * centre / scale).sum()), 4),
        notes=f"tuned by experiments/diagnosis/tune.py on {len(records)} cases of tuning seeds",
    )  # fmt: skip
    # The gate opens where at most so many cases with a known cause would pass it by mistake.
    passing = [
        decision.unknown_probability(r["rest"], r["paths"], set(r["effects"]), settings) for r in known
    ]
    threshold = float(np.clip(np.quantile(passing, 1.0 - FALSE_UNKNOWN), 0.4, 0.8))
    settings = dataclasses.replace(settings, unknown_threshold=round(threshold, 3))
    print(f"loss {loss:.3f}", settings)
    confusion(records, settings)
    decision.SETTINGS_FILE.write_text(json.dumps(dataclasses.asdict(settings), indent=1) + "\n")


def confusion(records, settings):
    """Print every miss and the share of right answers by kind."""
    right = {}
    for r in records:
        found = decision.decide_from(r["paths"], set(r["effects"]), r["rest"], settings)
        answer = ("unknown",) if found.unknown > settings.unknown_threshold else found.best
        truth = r["truth"] if r["kind"] not in ("none", "not_testable") else ()
        ok = merged(answer) == merged(truth)
        right.setdefault(r["kind"], []).append(ok)
        if not ok:
            gains = sorted(r["paths"]["sets"].items(), key=lambda kv: -kv[1])
            shown = "  ".join(
                f"{'+'.join(k)} {v:.0f}" for k, v in [g for g in gains if len(g[0]) == 1][:3] + gains[:1]
            )
            print(
                f"{r['name']} {r['kind']} {'+'.join(r['causes'])} ({r['severity']:.1f}) -> {'+'.join(answer) or '-'} "
                f"p_unknown {found.unknown:.2f} | {shown} | rate {r['paths']['rate']:.0f} pose {r['paths']['pose']:.0f}"
            )
    print({k: f"{sum(v)}/{len(v)}" for k, v in right.items()})


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    reading = commands.add_parser("read")
    reading.add_argument("--logs", type=Path, required=True)
    reading.add_argument("--answers", type=Path, required=True)
    reading.add_argument("--records", type=Path, required=True)
    reading.add_argument("--parts", type=int, default=1, help="split the cases over this many processes")
    reading.add_argument("--part", type=int, default=0)
    reading.set_defaults(run=read)
    fitting = commands.add_parser("fit")
    fitting.add_argument("files", nargs="+")
    fitting.set_defaults(run=fit)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()

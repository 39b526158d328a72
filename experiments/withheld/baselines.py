"""Two baselines on the same withheld cases.

    python -m experiments.withheld.baselines --logs OUT/logs --answers A.json --out
    experiments/results/withheld_baselines [--jobs N]

(a) All at once: every parameter of every effect is fitted together by bounded least squares (as mujoco.sysid
does), and the effect whose parameters moved most, in units of their standard errors, is named; none is named
below a threshold. Packet loss and mass (for thrust scale) are not parameters of such a fit. (b) A residual
network: random features of state, motors, voltage and neighbour, ridge-fitted to the nominal replay's
residuals; it closes a gap and names nothing. Both are scored on flights left out.
"""

import argparse
import json
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from experiments.withheld import baseline_model as model
from experiments.withheld import body as b
from experiments.withheld import diagnose_all, score, score_metrics

# change over its standard error below which nothing is named: 95th percentile over 40 nominal cases of tuning
# seed 1
THRESHOLD = 36.0
PRIOR = 0.1  # weak pull to the nominal, so that what the flights do not show stays where it was
NOMINAL = np.array([v[0] for v in model.PARAMETERS.values()])
LOWER, UPPER, USUAL = (np.array([v[i] for v in model.PARAMETERS.values()]) for i in (1, 2, 3))


def fit_all(windows, evaluations=12):
    """Parameters (n,) of the bounded least-squares fit of everything at once (robust loss), and their
    standard errors, residuals taken as white."""
    lower, upper = (LOWER - NOMINAL) / USUAL, (UPPER - NOMINAL) / USUAL

    def residuals(x):
        out = model.replay(windows, (NOMINAL + x * USUAL)[:, None])[:, :, 0].ravel()
        return np.concatenate([out / np.sqrt(windows["flight"].size), PRIOR * x])

    def jacobian(x):
        # one-sided differences, towards the inside of the box, all parameters in one replay
        step = np.where(x + 0.02 < upper, 0.02, -0.02)
        sets = np.concatenate([x[:, None], x[:, None] + np.diag(step)], axis=1)
        out = model.replay(windows, NOMINAL[:, None] + sets * USUAL[:, None]).reshape(-1, len(x) + 1)
        slopes = (out[:, 1:] - out[:, :1]) / step / np.sqrt(windows["flight"].size)
        return np.concatenate([slopes, PRIOR * np.eye(len(x))])

    # a start on the bound of a one-sided parameter (latency, saturation) would freeze it
    start = np.clip(np.zeros(len(NOMINAL)), lower + 0.01, upper - 0.01)
    fit = least_squares(
        residuals, start, jac=jacobian, bounds=(lower, upper), loss="soft_l1", max_nfev=evaluations
    )
    data = np.linalg.inv(fit.jac.T @ fit.jac)
    noise = 2 * fit.cost / max(len(fit.fun) - len(fit.x), 1)
    return NOMINAL + fit.x * USUAL, USUAL * np.sqrt(noise * np.diag(data))


def name_of(theta, errors, threshold=THRESHOLD):
    """(effects ranked by the largest standardised change of any of their parameters, their changes)."""
    changes = {}
    for name, change in zip(model.NAMES, np.abs(theta - NOMINAL) / errors, strict=True):
        effect = name.split(":")[0]
        changes[effect] = max(changes.get(effect, 0.0), float(change))
    order = sorted(changes, key=changes.get, reverse=True)
    return [e for e in order if changes[e] > threshold][:1], changes


def rms(residuals):
    return float(np.sqrt(np.mean(np.minimum(residuals**2, 1e4))))


def features(windows):
    """Inputs (W, n) of the residual network."""
    vb = b.rotate_back(windows["quaternion"], windows["velocity"])
    down = b.rotate_back(
        windows["quaternion"], np.repeat(np.array([[0.0], [0.0], [1.0]]), vb.shape[1], axis=1)
    )
    near = np.clip(windows["above"], -1, 1)
    now, before = windows["commands"][8], windows["commands"][7]
    z = windows["position"][2:3]
    parts = [
        vb,
        0.3 * windows["rates"],
        down,
        3 * (windows["rotor"] / b.MAX_SPEED - 0.79),
        z,
        np.exp(-z / 0.05),
        np.exp((z - b.CEILING) / 0.05),
        near,
        windows["voltage"][None] - 3.6,
        now - before,
        0.3 * now[1:],
        3 * (now[:1] - 0.62),
    ]
    return np.concatenate(parts).T


def network_gap(windows, nominal, hidden=300):
    """Gap before and after on flights left out, of a random-feature network fitted to the other flights'
    residuals.
    """
    x, y = features(windows), nominal.reshape(nominal.shape[0], -1).T
    rng = np.random.default_rng(0)
    weights, offset = rng.standard_normal((x.shape[1], hidden)) * 0.7, rng.uniform(0, 2 * np.pi, hidden)
    h = np.concatenate([np.ones((len(x), 1)), x, np.cos(x @ weights + offset)], axis=1)
    before, after = [], []
    for flight in np.unique(windows["flight"]):
        test = windows["flight"] == flight
        a, t = h[~test], np.clip(y[~test], -50, 50)
        gram = a.T @ a
        best = None
        for ridge in (3.0, 30.0, 300.0):
            coefficients = np.linalg.solve(gram + ridge * np.eye(len(gram)), a.T @ t)
            # generalised cross-validation on the training flights picks the ridge
            hat = np.einsum("ij,ji->i", a, np.linalg.solve(gram + ridge * np.eye(len(gram)), a.T)).sum()
            loss = np.mean((t - a @ coefficients) ** 2) / max(1 - hat / len(a), 1e-3) ** 2
            if best is None or loss < best[0]:
                best = (loss, coefficients)
        before.append(rms(y[test]))
        after.append(rms(y[test] - h[test] @ best[1]))
    return float(np.mean(before)), float(np.mean(after))


def run_case(folder):
    """(name, prediction of the fit, gap of the network) of one case."""
    start = time.perf_counter()
    windows = model.windows_of(folder)
    nominal = model.replay(windows, NOMINAL[:, None])[:, :, 0]
    effects, changes = name_of(*fit_all(windows))
    # held-out gap of the fit: fitted without the flight it is scored on
    before, after = [], []
    for flight in np.unique(windows["flight"]):
        test = windows["flight"] == flight
        theta, _ = fit_all({k: v[..., ~test] for k, v in windows.items()}, evaluations=8)
        own = {k: v[..., test] for k, v in windows.items()}
        before.append(rms(nominal[:, test]))
        after.append(rms(model.replay(own, theta[:, None])[:, :, 0]))
    total = sum(c**2 for c in changes.values()) + THRESHOLD**2
    probabilities = {e: c**2 / total for e, c in changes.items()} | {"none": THRESHOLD**2 / total}
    prediction = {
        "effects": effects,
        "probabilities": probabilities,
        "where": "",
        "not_testable": [],
        "reduction": 1 - float(np.mean(after)) / float(np.mean(before)),
        "seconds": time.perf_counter() - start,
        "changes": changes,
    }
    gap, rest = network_gap(windows, nominal)
    return folder.name, prediction, {"before": gap, "after": rest, "reduction": 1 - rest / gap}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help="path of the results without ending")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, help="score what is done by then")
    options = parser.parse_args()
    for key, value in diagnose_all.SINGLE_THREAD.items():
        diagnose_all.os.environ.setdefault(key, value)
    folders = diagnose_all.shuffled(
        sorted(p for p in options.logs.iterdir() if (p / "vehicle.toml").exists())
    )
    predictions, network = {}, {}
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        done = diagnose_all.results_in_time(
            pool.imap_unordered(run_case, folders), len(folders), options.seconds
        )
        for name, prediction, gap in done:
            predictions[name], network[name] = prediction, gap
            print(
                f"{len(predictions)}/{len(folders)} {name} {prediction['effects']}",
                flush=True,
            )
    answers = {n: a for n, a in json.loads(options.answers.read_text())["cases"].items() if n in predictions}
    result = score.score(answers, predictions, {})
    command = " ".join(["python -m experiments.withheld.baselines", *sys.argv[1:]])
    strong = [
        n
        for n, a in answers.items()
        if a["kind"] == "single" and a["severity"] in ("medium", "high") and n in network
    ]
    result["network"] = {
        "reduction": score_metrics.average([network[n]["reduction"] for n in strong], np.median),
        "made_larger": score_metrics.share(network[n]["reduction"] < 0 for n in network),
        "reduction_on_none": score_metrics.average(
            [network[n]["reduction"] for n, a in answers.items() if a["kind"] == "none"], np.median
        ),
    }
    # what the threshold would have to be for 5 % false alarms on these nominal cases; set from a tuning
    # seed, reported on others
    largest = [
        max(predictions[n]["changes"].values())
        for n, a in answers.items()
        if a["kind"] == "none" and n in predictions
    ]
    result["threshold"] = {
        "used": THRESHOLD,
        "for_5_percent_here": float(np.percentile(largest, 95)) if largest else None,
    }
    result |= {
        "provenance": score.provenance(command),
        "title": "All parameters at once, and a residual network",
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    Path(f"{options.out}.json").write_text(json.dumps(result, indent=1))
    keep = (
        "top1",
        "top1_medium_high",
        "pair_f1",
        "pair_exact",
        "false_alarm",
        "unknown_recall",
        "unknown_wrong_name",
        "calibration_error",
        "gap_reduction",
        "gap_negative",
        "seconds",
    )
    lines = [
        f"# {result['title']}",
        "",
        *(f"* {k}: `{v}`" for k, v in result["provenance"].items()),
        f"* cases: {result['cases']}",
        "",
        "| figure | measured | 95 % | n |",
        "|---|---|---|---|",
    ]
    shown = {"fit of everything: " + k: result["figures"][k] for k in keep} | {
        "network: " + k: v for k, v in result["network"].items()
    }
    for key, f in shown.items():
        if f["value"] is not None:
            lines.append(f"| {key} | {f['value']:.3f} | {f['low']:.3f} to {f['high']:.3f} | {f['n']} |")
    Path(f"{options.out}.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()

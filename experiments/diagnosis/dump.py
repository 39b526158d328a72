"""What the engine saw of cases, for decision rules that are tried without it.

    python -m experiments.diagnosis.dump --sets DIR … --mode alone --cores 60 --out FILE.pkl.xz
"""

import argparse
import lzma
import multiprocessing
import pickle
import sys
import time
import traceback
from pathlib import Path

from experiments.flying.single_thread import use_single_thread

LEVELS = 127


def squeezed(parts):
    """Rows of increments as bytes: sign and logarithm of size, with what undoes it."""
    import numpy as np

    x = np.concatenate([np.diff(p, axis=0) for p in parts])
    scale = np.maximum(np.median(np.abs(x), 0), 1e-9)
    reach = np.log1p(np.maximum(np.abs(x).max(0), 1e-9) / scale * 8.0)
    code = np.sign(x) * np.round(LEVELS * np.log1p(np.abs(x) / scale * 8.0) / reach)
    return {
        "code": code.astype(np.int8),
        "scale": scale.astype(np.float32),
        "reach": reach.astype(np.float32),
        "rows": [len(p) - 1 for p in parts],
    }


def study(job):
    """One case."""
    folder, mode = job
    from experiments.diagnosis import development, truth
    from experiments.diagnosis.healthy import healthy_beside

    use = {"healthy": True} if mode == "ref" else {}
    answers = truth.read_answers(
        folder.parent.with_name(folder.parent.name + "_answers.json")
    )
    try:
        from openjax.gap import diagnosis, residual

        seen = {"series": []}
        old_series, old_select = residual._series, diagnosis.select

        def series(evidence, residuals):
            out = old_series(evidence, residuals)
            kept = {n: squeezed(p) for n, p in out.items()}
            gusts = evidence.motion.gusts
            seen["series"].append(
                (evidence.tracks[0].dt, kept, gusts is not None)
            )
            return out

        def select(evidence):
            seen["evidence"] = evidence
            seen["selection"] = old_select(evidence)
            return seen["selection"]

        residual._series, diagnosis.select = series, select
        try:
            line = development.diagnose(
                (folder.parent.name, folder, answers[folder.name], use)
            )
        finally:
            residual._series, diagnosis.select = old_series, old_select
        healthy_beside(folder.parent)
        return line, seen["series"], of_selection(seen)
    except Exception:
        return {"case": folder.name, "set": folder.parent.name, "traceback": traceback.format_exc()}, [], {}


def of_selection(seen) -> dict:
    """What the search found."""
    import numpy as np

    from openjax.gap.selection import difference, growth, possible, practical

    if "selection" not in seen:
        return {}
    s, ev = seen["selection"], seen["evidence"]
    se = s.search
    best = se.best
    sets = []
    for h in se.visited.values():
        gain, error, trust = difference(best.judged, h.judged)
        gap = growth(h.judged.squares.sum(0), best.judged.squares.sum(0))
        beside = growth(
            h.judged.squares_beside(best.judged).sum(0), best.judged.squares.sum(0)
        )
        sets.append(
            {
                "effects": h.effects,
                "nats": np.float32(h.judged.nats.sum()),
                "blocks": h.judged.nats.astype(np.float16),
                "odds": h.log_odds,
                "support": h.support,
                "cost": h.fit.cost,
                "gain": gain,
                "error": error,
                "trust": trust,
                "growth": gap,
                "beside": beside,
                "possible": possible(h.fit),
                "practical": practical(h.fit, ev.measured),
                "score": h.fit.score,
                "parameters": h.fit.parameters() if len(h.effects) < 2 or h is s.chosen or h is best else None,
            }
        )
    from openjax.gap.channels import robust_deviation

    fit = s.fit
    idn = ev.identification
    names = np.array(ev.replay.nuisance_names)[ev.replay.shared]
    return {
        "sets": sets,
        "weights": {tuple(sorted(k)): v for k, v in s.weights.items()},
        "chosen": s.chosen.effects,
        "effects": s.effects,
        "theta": fit.theta[fit.index],
        "absent": fit.replay.absent[fit.index],
        "index": fit.index,
        "covariance": fit.covariance,
        "grams": fit.grams[:, :, 0],
        "robust": robust_deviation(fit.covariance, fit.grams[:, 1:, 0]) if len(fit.index) else None,
        "exposure": ev.motion.exposure,
        "identified": None
        if idn is None
        else (idn.trusted, {n: idn.estimates.of(*n) for n in idn.estimates.names}),
        "nuisances": dict(zip(names.tolist(), s.chosen.judged.taken.mean(0).tolist(), strict=True)),
        "nuisances_nothing": dict(zip(names.tolist(), se.nothing.judged.taken.mean(0).tolist(), strict=True)),
        "squares": s.chosen.judged.squares.astype(np.float32),
        "squares_nothing": se.nothing.judged.squares.astype(np.float32),
        "rows": s.table.rows,
        "track_of": s.table.track_of,
        "usable": ev.replay.usable,
        "flights": [t.flight for t in ev.tracks],
        "pwm": ev.case.vehicle_file.motor.command,
        "taken_blocks": s.chosen.judged.found[:, s.chosen.judged.nuisances].astype(np.float16),
        "nuisance_names": ev.replay.nuisance_names,
        "channels": {c.path: (c.acting(), c.named()) for c in ev.channels},
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", nargs="+", type=Path, required=True)
    parser.add_argument("--mode", choices=("alone", "ref"), default="alone")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--cases", type=int)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--out", type=Path, required=True)
    o = parser.parse_args()
    use_single_thread()
    begin = time.perf_counter()
    jobs = [
        (p.parent, o.mode) for s in o.sets for p in sorted(s.absolute().glob("*/vehicle.toml"))[: o.cases]
    ]
    found = []
    with multiprocessing.get_context("spawn").Pool(min(o.cores, len(jobs))) as pool:
        results = pool.imap_unordered(study, jobs)
        for n in range(len(jobs)):
            try:
                left = max(o.seconds - (time.perf_counter() - begin), 0.01)
                found.append(results.next(timeout=left))
            except multiprocessing.TimeoutError:
                print("time is up", len(jobs) - n, "left", file=sys.stderr)
                break
            if n % 10 == 0:
                print(n, len(jobs), f"{time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
    with lzma.open(o.out, "wb", preset=1) as file:
        pickle.dump(found, file)
    print(len(found), "cases", o.out.stat().st_size // 1024, "KiB", f"{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()

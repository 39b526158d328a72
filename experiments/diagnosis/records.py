"""Evidence of many tuning cases in one file, so that decisions can be settled without diagnosing again.

    python -m experiments.diagnosis.records --logs LOGS --answers ANSWERS.json --out RECORDS.npz [--jobs 16]
    [--seconds 300]

Every case is read once (`gather`) and reduced to numbers: scores of all sets, every full fit with its gram
matrices by flight, the other paths, looks at the rest, headroom of a flexible model. A single cause of some
strength is read a second time with the effect (and what stands in for it) left out of the library: a case whose
cause is unknown. After `--seconds` what has been read is written. The file holds JSON with arrays by reference into
one float32 array; nothing is pickled.
"""

import argparse
import json
import multiprocessing
import os
import time
import traceback
from pathlib import Path

import numpy as np

from experiments.withheld.diagnose_all import SINGLE_THREAD, results_in_time, shuffled

LEAST_LEFT_OUT = 1.8  # severity from which a single cause is read again with the effect left out


def read_case(job):
    """Record of one case: (key, plain numbers and arrays)."""
    key, folder, without, answer = job
    start = time.perf_counter()
    try:
        return key, _read(folder, without, answer) | {"seconds": time.perf_counter() - start}
    except Exception as error:
        traceback.print_exc()
        return key, {"error": f"{type(error).__name__}: {error}"}


def _read(folder, without, answer):
    from openjax.flights.case import load_case
    from openjax.gap import decision
    from openjax.gap.diagnosis import left_by
    from openjax.gap.evidence import gather
    from openjax.gap.hypotheses import SetFit
    from openjax.gap.library import library, path_of

    evidence = gather(load_case(folder), library(without))
    laps = dict(evidence.seconds)
    fits = sorted((f for f in evidence.sets.values() if isinstance(f, SetFit)), key=lambda f: -f.score)
    found = decision.decide(evidence, None, decision.load_settings())
    chosen = decision.best_fit(evidence, found.best)
    begin = time.perf_counter()
    # The sets that another decision could choose: what they leave is kept too.
    first = [next((f for f in fits if len(f.effects) == size), fits[0]) for size in (0, 1, 2)]
    truth = [e for e in answer["effects"] if e in evidence.library.effects and path_of(e) == "physics"]
    truth = tuple(e for e in evidence.library.physics if e in truth and (e,) in evidence.sets)
    if answer["kind"] in ("single", "pair") and truth:
        first.append(evidence.fit(truth))
    kept = {f.effects: f for f in (chosen, *first, fits[0])}
    left = {}
    for key, fit in kept.items():
        own = left_by(evidence, fit)
        left["+".join(key)] = own.room | {"rest": own.rest, "nuisances": own.nuisances}
    names, group = own.room["names"], own.room["group"]
    for entry in left.values():
        del entry["names"], entry["group"]
    laps["left"] = (time.perf_counter() - begin) / len(kept)
    paths = decision.path_scores(evidence)
    paths["sets"] = [[list(k), float(v)] for k, v in paths["sets"].items()]
    if paths["radio"] is not None:
        gain, loss = paths["radio"]
        paths["radio"] = [[[list(k), float(v)] for k, v in gain.items()], float(loss)]
    radio = evidence.radio
    return {
        "answer": answer,
        "effects": list(evidence.library.effects),
        "weighed": bool(evidence.case.vehicle_file.mass_weighed),
        "paths": paths,
        "radio": None if radio is None else {"delay": radio.delay, "loss": radio.loss, "informative": radio.informative},
        "rate_loop": None if evidence.rate_loop is None else evidence.rate_loop.grams,
        "pose": None if evidence.pose is None else evidence.pose.grams,
        "fits": [
            {
                "effects": list(f.effects), "score": f.score, "index": f.index.tolist(), "theta": f.theta[f.index],
                "covariance": f.covariance, "grams": f.grams,
            }
            for f in evidence.sets.values() if isinstance(f, SetFit) and f.effects and f.score > evidence.nothing.score
        ],
        "decided": list(found.best),
        "columns": list(names),
        "group": group.tolist(),
        "left": left,
        "laps": laps,
    }  # fmt: skip


def pack(records, path):
    """Write records: JSON in which arrays are {"@": [offset, shape]} of one float32 array."""
    parts, size = [], 0

    def plain(value):
        nonlocal size
        if isinstance(value, np.ndarray):
            flat = _rounded(np.ascontiguousarray(value, np.float32).reshape(-1))
            parts.append(flat)
            size += len(flat)
            return {"@": [size - len(flat), list(value.shape)]}
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        if isinstance(value, (float, np.floating)):
            return float(f"{value:.7g}")
        return value.item() if isinstance(value, np.generic) else value

    text = json.dumps(plain(records), separators=(",", ":")).encode()
    array = np.concatenate(parts) if parts else np.zeros(0, np.float32)
    partial = Path(f"{path}.part")
    with open(partial, "wb") as file:
        np.savez_compressed(file, text=np.frombuffer(text, np.uint8), array=array)
    partial.rename(path)


def _rounded(values):
    """float32 to a part in 30 000, which packs better."""
    bits = values.view(np.uint32).astype(np.uint64) + 128
    return (bits & 0xFFFFFF00).astype(np.uint32).view(np.float32)


def unpack(path):
    """The records that `pack` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        records, array = json.loads(stored["text"].tobytes()), stored["array"].astype(float)

    def back(value):
        if isinstance(value, dict):
            if list(value) == ["@"]:
                offset, shape = value["@"]
                return array[offset : offset + int(np.prod(shape))].reshape(shape)
            return {k: back(v) for k, v in value.items()}
        return [back(v) for v in value] if isinstance(value, list) else value

    return back(records)


def jobs_of(pairs, twins=True):
    """All readings of (logs, answers) pairs: first every case, then the strong singles with their effect left
    out."""
    from experiments.withheld.plan import LEFT_OUT

    first, second = [], []
    for logs, answers in pairs:
        table = json.loads(Path(answers).read_text())
        if table["seed"] >= 100:
            raise SystemExit(f"{answers}: seed {table['seed']} is for reporting, not for tuning")
        for name, answer in sorted(table["cases"].items()):
            key = f"{table['seed']}/{name}"
            answer = {k: v for k, v in answer.items() if k not in ("ratio_per_channel", "ticks")}
            first.append((key, logs / name, tuple(answer["without"]), answer))
            if answer["kind"] == "single" and answer["severity_ratio"] >= LEAST_LEFT_OUT and twins:
                twin = answer | {"kind": "left_out", "effects": ["unknown"], "twin": True}
                second.append((key + "/left_out", logs / name, tuple(LEFT_OUT[answer["effects"][0]]), twin))
    return shuffled(first) + second


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=Path, nargs="+", required=True)
    parser.add_argument("--answers", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--no-twins", action="store_true")
    parser.add_argument(
        "--parts", type=int, default=1, help="split the records over so many files, OUT_0.npz ..."
    )
    options = parser.parse_args()
    start = time.perf_counter()
    work = jobs_of(list(zip(options.logs, options.answers, strict=True)), not options.no_twins)
    for key, value in SINGLE_THREAD.items():
        os.environ.setdefault(key, value)
    records = {}
    pool = multiprocessing.get_context("spawn").Pool(min(options.jobs, len(work)))
    left = options.seconds - (time.perf_counter() - start)
    for key, record in results_in_time(pool.imap_unordered(read_case, work), len(work), left):
        records[key] = record
        if len(records) % 20 == 0 or len(work) < 40:
            spent = time.perf_counter() - start
            print(
                f"{len(records)}/{len(work)} {key} {record.get('seconds', 0):.1f} s, {spent:.0f} s",
                flush=True,
            )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for part in range(options.parts):
        own = {k: records[k] for k in sorted(records)[part :: options.parts]}
        out = options.out if options.parts == 1 else options.out.with_name(f"{options.out.stem}_{part}.npz")
        pack(own, out)
        print(f"{out}: {len(own)} records, {out.stat().st_size / 2**20:.1f} MiB", flush=True)
    pool.terminate()


if __name__ == "__main__":
    main()

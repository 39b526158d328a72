"""Diagnose every case of a folder of logs, in parallel processes that see nothing but the logs.

    python -m experiments.withheld.diagnose_all --logs OUT/logs --predictions P.json --reports R.json [--jobs
    8]

Writes the predictions in the format of the sealed flights' README (and the seconds that each case took) and
all full reports in one file. `without.json` in the logs folder names effects that the library must do without
in some cases.
"""

import argparse
import json
import multiprocessing
import os
import time
import traceback
from pathlib import Path

import numpy as np

# one thread per process: the cases are the parallel part. Set before JAX is imported by a worker.
SINGLE_THREAD = {
    "JAX_PLATFORMS": "cpu",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def diagnose_case(job):
    """(name, prediction, report) of one case folder; an error becomes an empty prediction with the reason."""
    folder, without = job
    start = time.perf_counter()
    try:
        prediction, report = _diagnose(folder, without)
    except Exception as error:  # one bad case must not lose the other hundreds; it is counted as a miss
        traceback.print_exc()
        prediction = {
            "effects": [],
            "probabilities": {"none": 1.0},
            "where": "",
            "reduction": 0.0,
            "not_testable": [],
            "error": f"{type(error).__name__}: {error}",
        }
        report = {"error": prediction["error"]}
    prediction["seconds"] = round(time.perf_counter() - start, 3)
    return folder.name, prediction, report


def _diagnose(folder, without):
    from openjax.gap import load_case
    from openjax.gap.diagnosis import diagnose_case as diagnose

    report = diagnose(load_case(folder), without=tuple(without))
    return report.prediction(), report.to_dict()


def shuffled(items):
    """The items in a fixed random order, so that what a time limit leaves is a fair sample."""
    return [items[i] for i in np.random.default_rng(0).permutation(len(items))]


def results_in_time(results, count, seconds=None):
    """Up to `count` results of an `imap_unordered`, as long as `seconds` last."""
    start = time.perf_counter()
    for _ in range(count):
        left = None if seconds is None else max(seconds - (time.perf_counter() - start), 0.01)
        try:
            yield results.next(timeout=left)
        except multiprocessing.TimeoutError:
            print(f"time is up after {seconds:.0f} s", flush=True)
            return


def diagnose_all(logs, jobs=1, limit=None, seconds=None):
    """All cases below `logs`, or those that `seconds` allow: ({case: prediction}, {case: report})."""
    told = logs / "without.json"
    without = json.loads(told.read_text()) if told.exists() else {}
    folders = sorted(p for p in logs.iterdir() if (p / "vehicle.toml").exists())[:limit]
    work = shuffled([(p, without.get(p.name, [])) for p in folders])
    predictions, reports, start = {}, {}, time.perf_counter()

    def keep(result):
        name, predictions[name], reports[name] = result
        print(
            f"{len(predictions)}/{len(work)} {name} {predictions[name]['effects'] or '-'} "
            f"{predictions[name]['seconds']:.1f} s, {time.perf_counter() - start:.0f} s in all",
            flush=True,
        )

    for key, value in SINGLE_THREAD.items():
        os.environ.setdefault(key, value)
    if jobs == 1:
        for job in work:
            keep(diagnose_case(job))
    else:
        with multiprocessing.get_context("spawn").Pool(min(jobs, len(work))) as pool:
            for result in results_in_time(pool.imap_unordered(diagnose_case, work), len(work), seconds):
                keep(result)
    return dict(sorted(predictions.items())), dict(sorted(reports.items()))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--predictions", type=Path, required=True)
    parser.add_argument("--reports", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=int, help="only the first so many cases")
    parser.add_argument("--seconds", type=float, help="with several jobs: write what is done by then")
    options = parser.parse_args()
    predictions, reports = diagnose_all(options.logs, options.jobs, options.limit, options.seconds)
    if all("error" in p for p in predictions.values()):
        raise SystemExit("no case could be diagnosed")
    for path, content in ((options.predictions, predictions), (options.reports, reports)):
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(
                json.dumps(content, separators=(",", ":"))
                if path == options.reports
                else json.dumps(content, indent=1)
            )


if __name__ == "__main__":
    main()

"""Diagnose every case below a folder as a user would: `python -m openjax.diagnose CASE`, in parallel processes.

    python -m experiments.diagnosis.diagnose LOGS --out DIAGNOSES [--jobs 8] [--seconds 300] [--study]

The processes see the logs alone. Beside what the command writes, `runs.json` holds for each case its seconds, exit
status, the one-line error or the traceback. The first case of a process compiles; `first` marks it. `--study` keeps what the
engine weighed, too (see `study`).
"""

import argparse
import contextlib
import io
import json
import multiprocessing
import sys
import time
import traceback
from pathlib import Path

import numpy as np

from experiments.diagnosis import study
from experiments.flying.single_thread import use_single_thread

_done = 0  # cases that this process has diagnosed


def diagnose_case(job):
    """(name, facts) of one case; its report lies in OUT/<name>/report.json if there is one."""
    global _done
    folder, out, keep_notes = job
    start, said, status, trace = time.perf_counter(), io.StringIO(), None, None
    try:
        from openjax.commands import diagnose
        from openjax.gap import report

        if keep_notes and _done == 0:
            report.write_report = study.with_notes(report.write_report)
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            status = diagnose.main([str(folder), "--out", str(out), "--no-html", "--overwrite"])
    except SystemExit as stop:
        status = stop.code
    except Exception:  # a traceback is a finding of the exam, not its end
        trace = traceback.format_exc()
    _done += 1
    facts = {"seconds": round(time.perf_counter() - start, 3), "status": status, "first": _done == 1}
    facts |= {"error": said.getvalue().strip()[-500:], "traceback": trace[-1500:] if trace else None}
    return folder.name, facts


def diagnose_all(logs, out, jobs=1, seconds=None, keep_notes=False):
    """All cases below `logs` in a fixed random order, or those that `seconds` allow: {case: facts}."""
    folders = sorted(p.parent for p in Path(logs).glob("*/vehicle.toml"))
    work = [(folders[i], Path(out), keep_notes) for i in np.random.default_rng(0).permutation(len(folders))]
    facts, start = {}, time.perf_counter()
    Path(out).mkdir(parents=True, exist_ok=True)
    use_single_thread()  # before a worker imports JAX

    def keep(result):
        facts[result[0]] = result[1]
        print(
            f"{len(facts)}/{len(work)} {result[0]} {result[1]['seconds']:.1f} s", file=sys.stderr, flush=True
        )

    if jobs == 1:
        for job in work:
            if seconds is None or time.perf_counter() - start < seconds:
                keep(diagnose_case(job))
    else:
        with multiprocessing.get_context("spawn").Pool(min(jobs, len(work))) as pool:
            results = pool.imap_unordered(diagnose_case, work)
            for _ in work:
                left = None if seconds is None else max(seconds - (time.perf_counter() - start), 0.01)
                try:
                    keep(results.next(timeout=left))
                except multiprocessing.TimeoutError:
                    print(f"time is up after {seconds:.0f} s", file=sys.stderr)
                    break
    (Path(out) / "runs.json").write_text(json.dumps(dict(sorted(facts.items())), indent=1))
    return facts


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, help="write what is done by then")
    parser.add_argument("--study", action="store_true", help="also write what the engine weighed")
    options = parser.parse_args()
    diagnose_all(options.logs, options.out, options.jobs, options.seconds, options.study)


if __name__ == "__main__":
    main()

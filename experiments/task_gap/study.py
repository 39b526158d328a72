"""How far the gap in the task shrinks once the diagnosed effects are in the simulator.

    python -m experiments.task_gap [--episodes 200] [--jobs N] [--work DIR] [--seconds 600]

For each case: flights of the exam's plant with one cause are diagnosed (`openjax.gap`), and a shipped policy then
plays the same tasks from the same starts in the nominal simulator, in the plant with that cause, and in the simulator
with the diagnosed effects.toml. Everything is kept in --work, so that a run that was cut short goes on. Writes
RESULTS.json and RESULTS.md (--results).
"""

import argparse
import multiprocessing
import os
import time
from pathlib import Path

from experiments.task_gap.flights import SIZES, make_cases
from experiments.task_gap.jobs import CONDITIONS, Job, do, read_flights
from experiments.task_gap.report import write_results

RESULTS = Path(__file__).parents[1] / "results" / "task_gap"


def run(jobs: list[Job], pool) -> None:
    """Do all jobs and say how it goes."""
    begin = time.perf_counter()
    for i, (what, seconds) in enumerate(pool.imap_unordered(do, jobs), 1):
        if what:
            elapsed = time.perf_counter() - begin
            print(f"{i}/{len(jobs)} {what} {seconds:.1f} s, {elapsed:.0f} s in all", flush=True)


def episode_jobs(cases, options, deadline) -> list[Job]:
    """All chunks of episodes, whole chunks of all worlds first, so that what is cut short can be compared."""
    work, out = options.work, []
    for condition in options.conditions:
        for start in range(0, options.episodes, options.chunk):
            number = min(options.chunk, options.episodes - start)
            rest = (work, options.policy, condition, start, number, deadline)
            out += [Job("nominal", None, *rest, substeps) for substeps in options.substeps]
            for case in cases:
                out.append(Job("plant", case, *rest))
                if read_flights(work, case)["found"]["parameters"]:  # else it is the nominal simulator
                    out += [Job("corrected", case, *rest, substeps) for substeps in options.substeps]
    return out


def main() -> None:
    """Run what isn't there yet, and write the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--policy", default="open")
    parser.add_argument("--episodes", type=int, default=200, help="per world")
    parser.add_argument("--chunk", type=int, default=100, help="episodes that one process flies at once")
    parser.add_argument("--replicates", type=int, default=2, help="cases of each effect")
    parser.add_argument("--nones", type=int, default=2)
    parser.add_argument("--effects", nargs="*", default=list(SIZES))
    parser.add_argument("--conditions", nargs="*", default=list(CONDITIONS), help=", ".join(CONDITIONS))
    parser.add_argument(
        "--substeps",
        type=int,
        nargs="*",
        default=[1, 5],
        help="of the simulators' 10 ms; 5: rate loop at 500 Hz",
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seconds", type=float, default=1e6, help="start nothing new after this long")
    parser.add_argument("--work", type=Path, default=Path("runs/task_gap"))
    parser.add_argument("--commit", help="written into the results where the tree has no repository")
    parser.add_argument("--results", type=Path, default=RESULTS, help="without ending")
    options = parser.parse_args()
    deadline = time.time() + options.seconds
    cases = make_cases(options.seed, options.replicates, options.nones, tuple(options.effects))
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        run([Job("flights", c, options.work, "", "", 0, 0, deadline) for c in cases], pool)
        cases = [c for c in cases if (options.work / "flights" / f"{c.name}.json").exists()]
        run(episode_jobs(cases, options, deadline), pool)
    write_results(cases, options)

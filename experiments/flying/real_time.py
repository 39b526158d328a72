"""Faults at their source in real time: `python -m experiments.flying.real_time
[--flights 100] [--processes 3]`.

Each worker compiles the policy once and has virtual Crazyflies of its own, in a process
that keeps where they truly were; what goes wrong is in `experiments.flying.processes`.
"""

import atexit
import functools
import json
import math
import random
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments.flying.faults import ENDING, MARGIN, finite
from experiments.flying.process_faults import GROUPS, KINDS, STOPPED, ends_flight
from experiments.flying.processes import Flown
from experiments.flying.single_thread import share_out
from experiments.table import RESULTS, Page, Table, facts, write_page
from openjax.files import read_json, write_json


@dataclass(frozen=True)
class Arguments:
    """Fly faults in real time."""

    flights: int = 100
    processes: int = 3
    policy: str = "flight"
    seed: int = 0
    only: tuple[str, ...] = ("",)
    """Kinds that contain one of these."""
    seconds_left: float = 1e9
    """Begin no flight after this time (s)."""
    go_on: bool = False
    """Fly what isn't in `out` yet."""
    out: Path = RESULTS / "flying_real_time.json"


def main() -> None:
    """Share the flights out to workers, each with vehicles of its own."""
    arguments = tyro.cli(Arguments)
    names = [kind for kind in KINDS if any(part in kind for part in arguments.only)]
    records = read_json(arguments.out)["records"] if arguments.go_on else []
    numbers = set(range(arguments.seed, arguments.seed + arguments.flights)) - {
        r["number"] for r in records
    }
    work = [(n, names[n % len(names)]) for n in sorted(numbers)]
    random.Random(arguments.seed).shuffle(
        work
    )  # whenever it stops, kinds were flown without favour
    stands = facts()
    jobs = [(number, kind, arguments.policy) for number, kind in work]
    for row in share_out(fly, jobs, arguments.processes, arguments.seconds_left):
        records.append(finite(row))
        print("well" if row["well"] else "NOT WELL", json.dumps(row), flush=True)
        well = sum(r["well"] for r in records)
        in_order = sorted(records, key=lambda r: r["number"])
        counts = {"flights": len(records), "well": well, "policy": arguments.policy}
        write_json(arguments.out, {**stands, **counts, "records": in_order})
    write_page(arguments.out, page, read_json(arguments.out))


def page(results) -> Page:
    """What became of the flights, by groups of kinds."""
    rows = []
    records = results["records"]
    for group, kinds in {**GROUPS, "all": KINDS}.items():
        mine = [r for r in records if r["kind"] in kinds]
        ends = [r["seconds"] for r in mine if r["seconds"] is not None and ends_flight(r["kind"])]
        is_stop = [any(name in r["kind"] for name in STOPPED) for r in mine]
        rows.append({
            "group": group, "flights": len(mine), "well": sum(r["well"] for r in mine),
            "farthest": 0.9 + max((r["out"] for r in mine), default=math.nan), "armed": sum(r["armed"] for r in mine),
            "fell": sum(r["fell"] and not a for r, a in zip(mine, is_stop, strict=True)),
            "left": sum(bool(r["left"]) for r in mine), "longest": max(ends, default=None),
        })  # fmt: skip
    columns = {
        "faults": "group", "flights": "flights:d", "as they must": "well:d", "farthest (m)": "farthest:.2f",
        "armed at the end": "armed:d", "fell unasked": "fell:d", "left a process": "left:d",
        "longest end (s)": "longest:.1f",
    }  # fmt: skip
    prose = (
        "`openjax fly` in processes and on a terminal of its own, real `cflib` over UDP; where the "
        "virtual vehicles truly "
        f"were. As they must: nobody more than {MARGIN:g} m out of the arena (.9 m), nobody armed "
        "at the end, no fall that "
        f"nobody asked for, no process left, down {ENDING:g} s after what must end the flight."
    )
    ill = [
        f"Not well: {r['kind']} (flight {r['number']}): {r['said']}"
        for r in records
        if not r["well"]
    ]
    return Page("Faults where they happen, in real time", prose, [Table(columns, rows), *ill])


def fly(number: int, kind: str, policy: str) -> dict:
    """What became of a flight."""
    return Flown(number, kind, *_made_once(policy)).fly()


@functools.cache
def _made_once(policy):
    """This process' virtual Crazyflies, how to fly them, and all that is compiled for
    it.
    """
    from experiments.flying.virtual import VirtualProcess
    from openjax.commands.fly import Arguments as FlyArguments
    from openjax.commands.fly import prepare
    from openjax.flying import real_time

    virtual = VirtualProcess("wall")
    atexit.register(virtual.close)
    arguments = FlyArguments(
        policy=policy, uri=tuple(virtual.uris), episode_seconds=8.0, body_logs=1
    )
    prepared = prepare(arguments)
    real_time.hurry()
    return virtual, arguments, prepared


if __name__ == "__main__":
    main()

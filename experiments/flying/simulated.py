"""Faults at their source, in simulated time: `python -m experiments.flying.simulated
[--faults 3000] [--processes 4]`.

Flights are those of `experiments.flying.fault_worlds`, faults those of
`experiments.flying.faults`. Counted is where the *true* vehicles are, from the fault to
the end: how far out, how high, whether one fell or stayed armed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments.flying.fault_worlds import fly
from experiments.flying.faults import BEYOND, ENDING, FALL, FOLLOWED, KINDS, MARGIN, finite
from experiments.flying.single_thread import share_out, use_single_thread
from experiments.table import RESULTS, Page, Table, facts, write_page
from openjax.files import read_json, write_json
from openjax.virtual_crazyflie.firmware import LEVEL_AFTER


@dataclass(frozen=True)
class Arguments:
    """Fly thousands of faults."""

    faults: int = 3000
    policy: str = "flight"
    layouts: tuple[str, ...] = ("wall", "random", "passage")
    seed: int = 0
    batch: int = 42
    """Worlds flown side by side."""
    processes: int = 4
    seconds_left: float = 1e9
    """Begin no batch that wouldn't be over by then (s)."""
    kinds: tuple[str, ...] = ("",)
    """Those that contain one of these; all by default."""
    level_after: float = LEVEL_AFTER
    """A firmware of one's own levels out so long (s) after the last set-point."""
    out: Path = RESULTS / "flying_faults.json"
    commit: str | None = None
    """Where git can't tell it."""


def well(row: dict) -> bool:
    """Whether a flight ended as it must."""
    in_time = row["seconds"] is None or row["seconds"] <= ENDING or row["kind"] in SLOW
    return row["out"] <= MARGIN and not (row["fell"] or row["hard"] or row["armed"]) and in_time


SLOW = (
    "packets lost",
    "poses out of order",
    "camera scaled",
    "camera late",
    "camera drifts",
    FOLLOWED,
)
"""These may take effect long after they begin."""
ALL = "all but drifts that the estimator follows, and processes that stand still"


def summary(records) -> list[dict]:
    """A row per kind."""
    rows = []
    for kind in (*KINDS, "none", ALL):
        kinds = {*KINDS} - {*BEYOND} if kind == ALL else {kind}
        mine = [r for r in records if r["kind"] in kinds]
        if not mine:
            continue
        seconds = [r["seconds"] for r in mine if r["seconds"] is not None and r["kind"] not in SLOW]
        rows.append(
            {
                "kind": kind,
                "faults": len(mine),
                "well": sum(map(well, mine)),
                "landed": sum(r["ended"] for r in mine),
                "out": sum(r["out"] > MARGIN for r in mine),
                "farthest": max(r["out"] for r in mine) + 0.9,
                "fell": sum(r["fell"] for r in mine),
                "hard": sum(r["hard"] for r in mine),
                "armed": sum(r["armed"] for r in mine),
                "longest": max(seconds, default=None),
                "nearest": min(r["nearest"] for r in mine),
            }
        )
    return rows


def jobs_of(arguments: Arguments) -> list[tuple]:
    """The arguments of `fly`, a batch each; whenever it stops, all kinds and layouts
    were flown as often.
    """
    jobs = []
    drawn = range(arguments.seed, arguments.seed + arguments.faults)
    seeds = [s for s in drawn if any(part in KINDS[s % len(KINDS)] for part in arguments.kinds)]
    for k, layout in enumerate(arguments.layouts):
        mine = [s for s in seeds if (s // len(KINDS)) % len(arguments.layouts) == k]
        # all batches are of one size: compiled once
        mine += [-1] * (-len(mine) % arguments.batch)
        batches = [mine[i : i + arguments.batch] for i in range(0, len(mine), arguments.batch)]
        jobs += [(batch, layout, arguments.policy, arguments.level_after) for batch in batches]
    return sorted(jobs, key=lambda job: job[0][0])


def main() -> None:
    arguments = tyro.cli(Arguments)
    begin = time.time()
    use_single_thread()  # before a worker imports JAX
    jobs = jobs_of(arguments)
    records = []
    stands = facts(arguments.commit)
    try:
        for more in share_out(fly, jobs, arguments.processes, arguments.seconds_left):
            records += more
            write_json(
                arguments.out,
                {
                    **stands,
                    "policy": arguments.policy,
                    "seconds": round(time.time() - begin),
                    "summary": list(map(finite, summary(records))),
                    "not_well": [finite(r) for r in records if not well(r)],
                },
            )
    finally:  # of what was flown, also where something failed
        if records:
            write_page(arguments.out, page, read_json(arguments.out))


def page(results) -> Page:
    """Rows of `summary`."""
    prose = (
        f"{sum(r['faults'] for r in results['summary'] if r['kind'] in KINDS)} flights of three "
        "vehicles with the policy "
        f"`{results['policy']}`, one fault each, from its moment to the end. As they must: nobody "
        f"more than {MARGIN:g} m out "
        f"of the arena (.9 m), no fall from above {FALL:g} m, nobody down hard, nobody armed at "
        "the end, motors off on the "
        f"floor {ENDING:g} s after a fault that ends the flight."
    )
    columns = {
        "fault": "kind",
        "flights": "faults:d",
        "as they must": "well:d",
        "landed": "landed:d",
        "out by more than .1 m": "out:d",
        "farthest (m)": "farthest:.2f",
        "fell": "fell:d",
        "hard": "hard:d",
        "on at the end": "armed:d",
        "longest end (s)": "longest:.1f",
        "nearest two (m)": "nearest:.2f",
    }
    return Page(
        "Faults where they happen, in simulated time",
        prose,
        Table(columns, results["summary"]),
        by_group(results["summary"]),
    )


SHOWN = {
    "the camera sends something wrong, late or nothing": ("camera",),
    "... its drift, which the estimator on board follows": ("camera drifts, the",),
    "poses, gyroscope or packets are lost or wrong": ("poses", "packets", "gyroscope"),
    "processes stop": ("loop", "links", "guard"),
    "the policy is silent, stuck or wild": ("policy",),
    "a battery, a link or a drone fails, a key": ("battery", "drone", "link lost", "key"),
    "all processes stand still for a while": ("all processes",),
}
"""Rows of the page, by how the kinds begin; the longest beginning counts."""


def by_group(rows: list[dict]) -> Table:
    """The page's table: kinds of one source together."""
    starts = {start: group for group, kinds in SHOWN.items() for start in kinds}
    grouped: dict[str, list[dict]] = {group: [] for group in SHOWN}
    for row in rows:
        if row["kind"] in KINDS:
            start = max((s for s in starts if row["kind"].startswith(s)), key=len)
            grouped[starts[start]].append(row)
    added = ("faults", "well", "out", "fell", "hard", "armed")
    records = [
        {"group": group, "farthest": max(r["farthest"] for r in rows)}
        | {name: sum(r[name] for r in rows) for name in added}
        for group, rows in grouped.items()
        if rows
    ]
    columns = {
        "what fails": "group",
        "flights": "faults:d",
        "as they must": "well:d",
        "out by more than .1 m": "out:d",
        "farthest (m)": "farthest:.2f",
        "fell": "fell:d",
        "down hard": "hard:d",
        "on at the end": "armed:d",
    }
    return Table(columns, records)


if __name__ == "__main__":
    main()

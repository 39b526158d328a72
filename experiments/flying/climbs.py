"""What the accelerometer tells of a drift of the height, on flights of real vehicles:
`python -m experiments.flying.climbs --flights FOLDER ...`.

A folder is a case of `docs/log_format.md`, or holds several, with velocity, attitude
and accelerometer. Each flight is judged as it is, as `openjax.flying.climb` judges a
vehicle's own estimate, and again with drifts added to its velocity: up and down, early
and late in the flight.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.diagnosis.real_flights import cases_of
from experiments.table import Page, Table, page_parser, publish
from openjax.flights.case import load_case
from openjax.flying.climb import Climb
from openjax.flying.controller import Pose

RISEN = 0.05
"""m above where it stood: from there on it flies."""
SOON = 6.0
"""A drift that is told later (s) isn't counted as told."""
BEGINS = {"early": (0.3, 1.0, 2.0, 3.0, 4.0), "late": (6.0, 8.0, 10.0)}
"""s in the air, when a drift begins."""
DRIFTS = [(speed, within) for speed in (0.1, 0.2, 0.3, 0.5) for within in (2.0, 4.0)]
"""(m/s, s within which it sets in)"""


def airborne(flight) -> list[tuple[Pose, tuple]]:
    """Poses and specific forces of a flight, from take-off to landing."""
    is_known = np.isfinite(np.c_[flight.velocity, flight.quaternion, flight.specific_force]).all(1)
    height = flight.position[:, 2]
    up = np.flatnonzero(height > np.nanmin(height) + RISEN)
    return [
        (
            Pose(
                float(flight.time[k]),
                tuple(flight.position[k].tolist()),
                tuple(flight.velocity[k].tolist()),
                tuple(flight.quaternion[k].tolist()),
            ),
            tuple(flight.specific_force[k].tolist()),
        )
        for k in range(up[0], up[-1] + 1)
        if is_known[k]
    ]


def judged(rows, speed: float = 0.0, within: float = 1.0, begin: float = 0.0):
    """(the largest smoothed sum (m/s), when it was told (s in the air) or None)."""
    climb = Climb()
    largest = 0.0
    end_time = None
    first = rows[0][0].time
    for true, force in rows:
        t = true.time - first
        drift = speed * min(max((t - begin) / within, 0.0), 1.0)
        pose = true._replace(velocity=(*true.velocity[:2], true.velocity[2] + drift))
        climb = climb.update(pose, force)
        largest = max(largest, abs(climb.smooth))
        if end_time is None and climb.contradicts:
            end_time = t
    return largest, end_time


def study(options) -> dict:
    """Of each flight its largest sum; of each drift the share that is told, and how
    late.
    """
    flights = [
        airborne(flight)
        for folder in options.folders
        for case in cases_of(folder)
        for flight in load_case(case).flights
    ]
    largest = [judged(rows)[0] for rows in flights]
    rows = []
    for speed, within in DRIFTS:
        row = {"speed": speed, "within": within}
        for name, begins in BEGINS.items():
            delays = []
            for begin in begins:
                end_times = [
                    judged(f, sign * speed, within, begin)[1] for f in flights for sign in (1, -1)
                ]
                delays += [np.inf if t is None else t - begin for t in end_times]
            delays = np.array(delays)
            row[name] = float((delays < SOON).mean())
            row[f"{name}_seconds"] = float(np.median(delays[delays < SOON])) if row[name] else None
        rows.append(row)
    return {
        "flights": len(flights),
        "seconds_in_the_air": float(sum(f[-1][0].time - f[0][0].time for f in flights)),
        "largest": sorted(round(x, 4) for x in largest),
        "rows": rows,
    }


def page(results) -> Page:
    """The study's table."""
    prose = f"Of {results['flights']} flights the largest sum was {results['largest'][-1]:.2f} m/s."
    columns = {
        "drift of the height (m/s)": "speed:g",
        "sets in within (s)": "within:g",
        "told, early": "early:.2f",
        "after (s)": "early_seconds:.1f",
        "told, late": "late:.2f",
        "after (s), late": "late_seconds:.1f",
    }
    return Page(
        "What an accelerometer tells of a drifting height", prose, Table(columns, results["rows"])
    )


if __name__ == "__main__":
    parser = page_parser(__doc__, "flying_climbs")
    parser.add_argument("--flights", dest="folders", type=Path, nargs="+", required=True)
    publish(parser.parse_args(), study, page)

"""The tables' scripts: behaviours of flights made by hand, and verdicts of records made
by hand.
"""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.evaders.catch_map import fastest_caught
from experiments.paper import behaviours, main_tables, sweeps, tables
from experiments.paper.roster import METHODS, seeds_of
from experiments.paper.values import MAIN
from experiments.table import RESULTS, with_table
from openjax.files import read_json

pytestmark = pytest.mark.slow


def flight(pursuers, evader, capture, who=0, seen=None):
    """One episode (leading axis 1) of pursuers (T, N, 2) and evader (T, 2), captured by
    `who` in step `capture`.
    """
    pursuers = np.asarray(pursuers, float)
    evader = np.asarray(evader, float)
    steps, number = pursuers.shape[:2]
    captured = np.zeros((1, steps, number), bool)
    if capture is not None:
        captured[0, capture - 1 :, who] = True
    paths = SimpleNamespace(
        pursuers=np.concatenate([pursuers, np.full((steps, number, 1), 0.5)], axis=-1)[None],
        evader=np.concatenate([evader, np.full((steps, 1), 0.5)], axis=-1)[None],
        seen=np.ones((1, steps), bool) if seen is None else np.asarray(seen)[None],
        captured=captured,
    )
    counted = SimpleNamespace(
        captured=np.array([capture is not None]), capture_step=np.array([capture or steps])
    )
    return paths, counted


def line(start, end, steps=20):
    return np.linspace(start, end, steps)


@pytest.mark.parametrize(
    ("second", "capture", "expected"), [(-0.7, 20, 1.0), (0.7, 20, 0.0), (-0.7, 5, 0.0)]
)
def test_both_sides_means_both_ends_at_once_before_the_capture(second, capture, expected):
    first = line([0.6, 0.7], [-0.3, 0.7])
    other = line([0.6, second], [-0.3, second])
    paths, counted = flight(np.stack([first, other], axis=1), line([-0.8, 0], [-0.8, 0]), capture)
    assert behaviours.measure("wall", paths, counted)["both sides"] == expected


@pytest.mark.parametrize(("heights", "expected"), [((0.5, 0.0, -0.5), 1.0), ((0.5, 0.1, 0.0), 0.0)])
def test_three_ways_are_three_corridors(heights, expected):
    pursuers = np.stack([line([0.5, y], [0.2, y]) for y in heights], axis=1)
    paths, counted = flight(pursuers, line([0, 0.6], [0, 0.6]), None)
    assert behaviours.measure("passage", paths, counted)["three ways"] == expected


def test_a_catch_from_ahead_is_told_from_one_from_behind_and_ways_are_compared():
    evader = line([0.0, 0.0], [1.0, 0.0])
    ahead = line([1.2, 0.0], [1.1, 0.0])
    behind = line([-0.5, 0.0], [0.9, 0.0])
    pursuers = np.stack([ahead, behind], axis=1)
    met = behaviours.measure("narrow_gap", *flight(pursuers, evader, 20, who=0))
    followed = behaviours.measure("narrow_gap", *flight(pursuers, evader, 20, who=1))
    assert met["met"] == 1.0 and followed["met"] == 0.0
    np.testing.assert_allclose([met["shorter way"], followed["shorter way"]], [0.1, 1.4], rtol=1e-6)


def test_sight_is_counted_until_the_capture():
    seen = np.arange(20) >= 5
    still = np.zeros((20, 1, 2))
    found = behaviours.measure("hidden", *flight(still, still[:, 0], 10, seen=seen))
    assert found == {"seen": 6.0, "lost": 0.5}


def test_every_method_has_its_seeds():
    for method in METHODS:
        seeds = seeds_of(method)
        assert len(seeds) in (0, 3) and len(set(seeds)) == len(seeds)
    assert [name for name, _ in seeds_of("OPEN")] == ["open", "open_seed_1", "open_seed_2"]


def test_the_page_says_where_open_is_not_better_and_where_we_are_worse_than_the_paper():
    def flights(method, rate, step, collisions):
        record = {
            "capture_rate": rate,
            "capture_step": step,
            "collision_rate": collisions,
            "crash_rate": 0.0,
        }
        layouts = {layout: {"record": record} for layout in MAIN}
        return {"method": method, "condition": "clamp", "layouts": layouts}

    flown = [flights("OPEN", 1.0, 200, 0.001), flights("APF", 0.26, 150, 0.5)]
    text = main_tables.verdicts({"flights": flown})
    assert "wall: APF has the better capture step" in text and "better capture rate" not in text
    assert "random, APF: capture rate 0.26 against 0.314" in text
    assert "narrow_gap, APF: capture rate" not in text and "random, OPEN" not in text


def test_sweeps_say_where_open_is_not_above():
    def seeds(rates, steps):
        return [{"radius": {"capture_rate": rates, "capture_step": steps}}]

    methods = {"APF": seeds([0.5, 1.0], [700, 90]), "OPEN": seeds([0.4, 1.0], [700, 100])}
    text = sweeps.not_above(methods, "radius", (0.1, 0.3), "m")
    assert "APF at 0.1 m (0.50 / 700 against 0.40 / 700); APF at 0.3 m" in text
    assert "No method is above" in sweeps.not_above(
        {"OPEN": methods["OPEN"]}, "radius", (0.1, 0.3), "m"
    )


STUDIES = {
    "catch_map": "experiments.evaders.catch_map",
    "changes": "experiments.diagnosis.changes",
    "evaders": "experiments.evaders.cross_play",
    "exam": "experiments.diagnosis.run",
    "flying_estimates": "experiments.flying.estimates",
    "flying_faults": "experiments.flying.simulated",
    "flying_real_time": "experiments.flying.real_time",
    "quick": "experiments.paper.quick",
    "seconds": "experiments.speed.seconds",
    "teams": "experiments.evaders.teams",
    "vehicles": "experiments.flying.vehicles",
    "worlds": "experiments.flying.worlds.study",
}


@pytest.mark.parametrize("name", [*STUDIES, *tables.PAGES])
def test_the_table_of_a_page_is_that_of_the_stored_results(name):
    """One made by hand, elsewhere, or before the code that writes it changed would
    differ.
    """
    if name in STUDIES:
        page = importlib.import_module(STUDIES[name]).page
        results = read_json(RESULTS / f"{name}.json")
    else:
        page = tables.PAGES[name][0]
        results = read_json(RESULTS / "tables.json")
    written = (RESULTS / f"{name}.md").read_text(encoding="utf-8")
    assert written == with_table(written, page(results))


def test_the_fastest_that_is_caught_is_below_the_first_that_gets_away():
    rates = {0.8: 0.97, 1.2: 0.9, 1.6: 0.4, 2.0: 0.93}
    cells = {(3, ratio, 0.3): {"capture_rate": rate} for ratio, rate in rates.items()}
    assert fastest_caught(cells, 0.3) == 1.2
    assert fastest_caught({(3, 0.8, 0.3): {"capture_rate": 0.5}}, 0.3) is None

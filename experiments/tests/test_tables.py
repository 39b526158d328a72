"""The tables' scripts: verdicts of records made by hand, and pages as stored."""

import importlib

import pytest

from experiments.evaders.catch_map import fastest_caught
from experiments.paper import main_tables
from experiments.paper.roster import METHODS, seeds_of
from experiments.paper.values import MAIN
from experiments.table import RESULTS, with_table
from openjax.files import read_json

pytestmark = pytest.mark.slow


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


STUDIES = {
    "catch_map": "experiments.evaders.catch_map",
    "changes": "experiments.diagnosis.changes",
    "exam": "experiments.diagnosis.run",
    "judged": "experiments.evaders.judged",
    "quick": "experiments.paper.quick",
    "seconds": "experiments.speed.seconds",
    "tab_main": "experiments.paper.main_tables",
    "teams": "experiments.evaders.teams",
    "vehicles": "experiments.flying.vehicles",
}


@pytest.mark.parametrize("name", STUDIES)
def test_the_table_of_a_page_is_that_of_the_stored_results(name):
    """One made by hand, elsewhere, or before the code that writes it changed would differ."""
    page = importlib.import_module(STUDIES[name]).page
    results = read_json(RESULTS / f"{'tables' if name == 'tab_main' else name}.json")
    written = (RESULTS / f"{name}.md").read_text(encoding="utf-8")
    assert written == with_table(written, page(results))


def test_the_fastest_that_is_caught_is_below_the_first_that_gets_away():
    rates = {0.8: 0.97, 1.2: 0.9, 1.6: 0.4, 2.0: 0.93}
    cells = {(3, ratio, 0.3): {"capture_rate": rate} for ratio, rate in rates.items()}
    assert fastest_caught(cells, 0.3) == 1.2
    assert fastest_caught({(3, 0.8, 0.3): {"capture_rate": 0.5}}, 0.3) is None

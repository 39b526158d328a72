"""The map of what can be caught."""

import dataclasses
import json
import re

import jax.numpy as jnp
import pytest
from scipy.stats import binomtest

import openjax
from openjax.evaluation.episodes import wilson
from openjax.pursuit import PursuitSettings
from openjax.runs.catch_map import draw_map, map_game
from openjax.runs.map_page import map_page
from openjax.runs.options import MapCommand
from openjax.store.policies import own_controller

GAME = PursuitSettings(
    physics="rigid", contacts=False, episode_length=5, num_pursuers=3, team_sizes=(1, 3)
)
COMMAND = MapCommand(
    sizes=(1, 3),
    speed_ratios=(0.8, 1.4),
    radii=(0.02, 0.25, 3.0),
    evaders=("frozen", "way_points"),
    episodes=2,
    batch=9,
)


def test_cells_are_games_of_their_own():
    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    policy = own_controller(still, GAME, "still")
    lines = []
    found = draw_map(COMMAND, policy, lines.append)
    assert len(lines) == 3 and lines[-1].startswith("24 of 24 episodes")
    cells = {
        (cell["num_pursuers"], cell["speed_ratio"], cell["capture_radius"]): cell
        for cell in found["cells"]
    }
    assert len(cells) == 12
    for (number, _, radius), cell in cells.items():
        # nobody comes near the other side within 50 ms; the whole arena is within three metres
        assert cell["capture_rate"] == float(radius == 3.0)
        assert cell["episodes"] == 2
        # one pursuer in the middle leaves .6 m above and below it
        assert (cell["forced_below"] > 0.0) == (radius == 3.0 or (number == 3 and radius > 0.2))
        assert cell["planar_below"] >= cell["forced_below"] or radius == 3.0
    shown = re.search(r'<script id="data"[^>]*>(.*?)</script>', map_page({"empty <1>": found}))
    (only,) = json.loads(shown[1])
    assert only["name"] == "empty <1>" and len(only["cells"]) == 12


def test_intervals_of_proportions_are_wilsons():
    for hits, number in ((0, 9), (3, 10), (200, 200)):
        theirs = binomtest(hits, number).proportion_ci(method="wilson")
        assert wilson(hits, number) == pytest.approx(tuple(theirs), abs=1e-4)


def test_a_policy_for_three_has_one_map():
    three = dataclasses.replace(GAME, team_sizes=())
    with pytest.raises(openjax.UserError, match="flies with 3 pursuers only"):
        map_game(COMMAND, three)
    assert map_game(dataclasses.replace(COMMAND, sizes=(3,)), three).num_pursuers == 3
    with pytest.raises(openjax.UserError, match="--radii needs"):
        map_game(dataclasses.replace(COMMAND, radii=()), GAME)

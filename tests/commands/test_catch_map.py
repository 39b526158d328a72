"""The map of what can be caught."""

import dataclasses
import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest

import openjax
from openjax.commands.catch_map import draw_map, map_game
from openjax.commands.map_evaders import least_caught
from openjax.commands.map_page import map_page
from openjax.commands.options import MapCommand
from openjax.evaluation.episodes import wilson
from openjax.evaluation.judges.settings import BestResponseSettings, PlannerSettings
from openjax.pursuit import PursuitSettings, RewardSettings
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
    best_response=False,
)


def test_cells_are_games_of_their_own():
    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    policy = own_controller(still, GAME, "still")
    lines = []
    kept = []
    found = draw_map(COMMAND, policy, lines.append, kept.append)
    assert kept == [found]
    assert len(lines) == 3 and lines[-1].endswith("24 of 24 episodes")
    cells = {
        (cell["num_pursuers"], cell["speed_ratio"], cell["capture_radius"]): cell
        for cell in found["cells"]
    }
    assert len(cells) == 12
    for (number, _, radius), cell in cells.items():
        # nobody comes near the other side within 50 ms; the whole arena is within three
        # metres
        assert cell["capture_rate"] == float(radius == 3.0)
        assert cell["episodes"] == 2
        # one pursuer in the middle leaves .6 m above and below it
        assert (cell["forced_below"] > 0.0) == (radius == 3.0 or (number == 3 and radius > 0.2))
        assert cell["planar_below"] >= cell["forced_below"] or radius == 3.0
    shown = re.search(r'<script id="data"[^>]*>(.*?)</script>', map_page({"empty <1>": found}))
    (only,) = json.loads(shown[1])
    assert only["name"].startswith("empty <1>, ") and len(only["cells"]) == 12


@pytest.mark.slow
def test_evaders_learn_and_plan_in_the_cells_and_fly_again_from_their_file(tmp_path):
    """A team that stays where it starts is never near who has learned to stay away, and
    always where the reach is the whole arena.
    """

    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    policy = own_controller(still, GAME, "still")
    command = dataclasses.replace(
        COMMAND,
        best_response=True,
        evaders_out=tmp_path / "evaders.npz",
        learning=BestResponseSettings(
            learners=2, num_envs=2, rollout_length=2, total_steps=32, minibatches=4
        ),
        planner_share=0.5,
        planner_episodes=1,
        planning=PlannerSettings(plans=3, pieces=1, piece_steps=1, replan=5),
    )
    kept = []

    def keep(known):
        kept.append({name for cell in known["cells"] for name in cell})

    found = draw_map(command, policy, lambda text: None, keep)
    # cut off while it flies, a map holds what has flown
    new = [sorted(own - kept[0]) for own in kept]
    assert new == [[], [], ["learned"], ["learned", "planner"]]
    again = dataclasses.replace(command, learned=command.evaders_out, evaders_out=None)
    flown_again = draw_map(again, policy, lambda text: None)
    assert found["curve"] and flown_again["curve"] == found["curve"]
    for cell, other in zip(found["cells"], flown_again["cells"], strict=True):
        assert cell == other
        for who in ("learned", "planner"):
            if who in cell:
                assert cell[who]["capture_rate"] == float(cell["capture_radius"] == 3.0)
    planned = [cell["planner"]["episodes"] for cell in found["cells"] if "planner" in cell]
    assert planned == [1] * 6
    shown = map_page({"empty": found})
    assert "learned to escape from this team" in shown
    with pytest.raises(openjax.UserError, match=r"--learned.*openjax map writes one"):
        draw_map(dataclasses.replace(again, learned=tmp_path / "no.npz"), policy, print)


def test_who_is_caught_least_is_chosen_by_the_other_half():
    caught = np.array([[0, 1], [1, 0], [0, 1], [1, 0]], bool)
    np.testing.assert_array_equal(least_caught(caught), [1, 0, 1, 0])


def test_intervals_of_proportions_are_wilsons():
    for hits, number in ((0, 9), (3, 10), (200, 200)):
        theirs = binomtest(hits, number).proportion_ci(method="wilson")
        assert wilson(hits, number) == pytest.approx(tuple(theirs), abs=1e-4)


def test_a_policy_for_three_has_one_map():
    three = dataclasses.replace(GAME, team_sizes=())
    with pytest.raises(openjax.UserError, match="flies only 3 pursuers"):
        map_game(COMMAND, three)
    assert map_game(dataclasses.replace(COMMAND, sizes=(3,)), three).num_pursuers == 3
    with pytest.raises(openjax.UserError, match="--radii needs"):
        map_game(dataclasses.replace(COMMAND, radii=()), GAME)


def test_a_map_knows_no_shortest_paths_whatever_the_training_paid_for():
    """They would be found anew at each start, for nothing."""
    paid = dataclasses.replace(GAME, reward=RewardSettings(path=0.5))
    assert paid.reward.needs_paths
    assert not map_game(COMMAND, paid).reward.needs_paths

"""Another policy in a run's game."""

import dataclasses

import numpy as np
import pytest

import openjax
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings
from openjax.runs.other_policy import game_for, other_policy


@pytest.mark.slow
def test_it_plays_the_runs_game_and_steers_as_it_was_trained_to():
    """In steps and episodes of its own length, which the record counts in the run's."""
    run = PursuitSettings(
        physics="rigid",
        time_step=0.02,
        substeps=2,
        episode_length=60,
        evader_speed=0.5,
        start_attitude="level",
    )
    policy = openjax.load_policy("apf")
    rows, flights = other_policy("apf", Pursuit(run)).fly([SCENARIOS["empty"]], 1, 2)
    assert [(row["scenario"], row["episodes"]) for row in rows] == [("validation", 2), ("empty", 1)]
    flight = flights[1]
    assert (
        flight.title == "empty, apf"
        and flight.time_step == 0.01
        and len(flight.evader_position) == 120
    )
    speed = np.linalg.norm(np.diff(flight.evader_position, axis=0), axis=-1) / flight.time_step
    np.testing.assert_allclose(speed, run.evader_speed, rtol=1e-2)

    game = dataclasses.replace(game_for(Pursuit(run), policy).settings, max_pillars=run.max_pillars)
    record = openjax.evaluate(policy, "empty", episodes=1, **vars(game))
    assert record["capture_rate"] == rows[1]["capture_rate"]
    assert record["capture_step"] == 2 * rows[1]["capture_step"]


def test_it_sees_what_it_was_trained_to_see_in_games_that_show_more():
    run = PursuitSettings(observe_game=True, observe_arena=True, history_pursuers=False)
    policy = openjax.load_policy("flight")
    game = game_for(Pursuit(run), policy)
    assert not game.settings.observe_game and not game.settings.observe_arena
    policy.in_game(game)

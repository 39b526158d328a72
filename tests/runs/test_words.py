"""What a run says fits its game."""

import dataclasses
from pathlib import Path

from openjax.learning import preset
from openjax.runs.words import closing_words, layouts_like, opening_words


def test_another_game_is_said_to_be_one_and_judged_by_layouts_like_it():
    game = dict(evader_speed=0.8, arena_radius=1.5, min_pillars=0, max_pillars=3)
    easy = preset("quick", environment=game)
    assert [layout.name for layout in layouts_like(easy.environment)] == ["empty"]
    lines = closing_words(easy, Path("runs/train"), on_cpu=True)
    assert (
        len(lines) == 3
        and "0.8 m/s instead of 1.3, an arena of 1.5 m instead of 0.9" in lines[1]
        and "0 to 3 pillars" in lines[1]
    )
    assert "--scenario empty" in lines[2] and "--preset paper" in lines[2]


def test_the_papers_game_is_judged_by_all_six():
    paper = preset("paper")
    assert len(layouts_like(paper.environment)) == 6
    assert not any(
        "Easier" in line for line in closing_words(paper, Path("runs/train"), on_cpu=False)
    )


def test_a_changed_preset_is_not_announced_as_the_preset():
    flight = preset("flight")
    assert opening_words(dataclasses.replace(flight, seed=3)).startswith(
        "preset flight: Policies to be flown"
    )
    changed = preset("flight", environment=dict(evader_speed=2.0), num_envs=20480)
    assert opening_words(changed).startswith(
        "preset flight, changed in environment.evader_speed, num_envs: "
    )

"""What a run says at its end fits its game."""

from pathlib import Path

from openjax.commands.closing_words import closing_words, layouts_like
from openjax.learning import preset


def test_an_easier_game_is_said_to_be_one_and_judged_by_layouts_like_it():
    quick = preset("quick")
    assert [layout.name for layout in layouts_like(quick.environment)] == ["empty"]
    lines = closing_words(quick, Path("runs/train"), on_cpu=True)
    assert len(lines) == 3 and "0.8 m/s instead of 1.3" in lines[1]
    assert "--scenario empty" in lines[2] and "--preset paper" in lines[2]


def test_the_papers_game_is_judged_by_all_six():
    paper = preset("paper")
    assert len(layouts_like(paper.environment)) == 6
    assert not any("Easier" in line for line in closing_words(paper, Path("runs/train"), on_cpu=False))

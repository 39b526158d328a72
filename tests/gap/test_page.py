"""What the page of a diagnosis says first: one sentence, and what to do next, which
depends on the case.
"""

import dataclasses
import inspect
import shlex
from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap.report import Estimate, Report
from openjax.gap.report.figures import Course, rms
from openjax.gap.report.page import next_steps, page_of, shares
from openjax.gap.shares import Gap, Share, Split


def report(verdict, effects=(), parameters=(), **more):
    """A report with shares of .7 for the first effect and .2 for the others."""
    named = [effect for effect in effects if effect != "unknown"]
    found = {e: Share(0.2 if i else 0.7, (0.1, 0.8)) for i, e in enumerate(named)}
    gap = Gap("rms", 4.0, 1.2, 1.0, 0.7, (0.6, 0.8))

    fields = {name: {} for name in inspect.signature(Split).parameters}
    fields |= {
        "gap": gap,
        "effects": found,
        "sensors": Share(0.1, (0.0, 0.2)),
        "unexplained": Share(0.0, (0.0, 0.1)),
    }
    values = {e: {"size": Estimate(1.0, "N", (0.5, 1.5), (0.0, 2.0))} for e in parameters}
    filled = {
        "equivalent": {},
        "not_testable": [],
        "next_flight": "Fly 'low' next.",
        "to_show": "rate gains: quick turns.",
        "quality": [],
    } | more
    return Report(
        case="tuesday", verdict=verdict, effects=tuple(effects), probabilities={"none": 0.5, "unknown": 0.3},
        shares=Split(**fields), parameters=values, where=[], gap=gap, **filled
    )  # fmt: skip


CASES = {
    "effect": report("effect", ["rotor_x"], ["rotor_x"]),
    "two": report("effect", ["rotor_x", "y"], ["rotor_x", "y"], equivalent={"y": ["z"]}),
    "none": report("none", not_testable=["z"]),
    "unknown": report("unknown", ["unknown"], rest="It follows the height."),
    "not testable": report("not_testable", not_testable=["y", "z"]),
}


def test_next_steps_depend_on_the_case():
    commands = {
        name: [command for _, command in next_steps(case) if command]
        for name, case in CASES.items()
    }
    assert any("train" in command for command in commands["effect"])
    assert not any(
        "train" in command
        for name in ("none", "unknown", "not testable")
        for command in commands[name]
    )
    assert any("--reference tuesday" in command for command in commands["none"])
    told = {name: " ".join(why for why, _ in next_steps(case)) for name, case in CASES.items()}
    assert "can't tell y from z. Fly 'low' next" in told["two"]
    assert "It follows the height" in told["unknown"]
    assert "To show rate gains: quick turns" in told["not testable"]
    assert len(set(told.values())) == len(CASES)


def test_the_flight_that_tells_causes_apart_comes_first_then_adapting_then_training():
    case = report("effect", ["mass", "x"], ["mass", "x"], equivalent={"mass": ["thrust_scale"]})
    whys, commands = zip(*next_steps(case), strict=True)
    assert "can't tell mass from thrust_scale. Fly 'low' next" in whys[0]
    assert [c.split()[1] for c in commands[:3]] == ["plan", "adapt", "train"]


@pytest.mark.parametrize("verdict", ["none", "unknown", "effect"])
@pytest.mark.parametrize("place", ["flights/tuesday", "my flights/a b"])
def test_commands_find_their_files_from_the_folder_of_the_page(verdict, place, tmp_path):
    """Capitals stand for folders that only the reader knows."""
    case = tmp_path / place
    page = tmp_path / "diagnosis" / case.name
    case.mkdir(parents=True)
    page.mkdir(parents=True)
    (page / "effects.toml").write_text("")
    names = {"none": [], "unknown": ["unknown"], "effect": ["x"]}[verdict]
    evidence = SimpleNamespace(case=SimpleNamespace(path=case))
    made = report(verdict, names, [n for n in names if n != "unknown"])
    made = dataclasses.replace(made, plots={"evidence": evidence})
    commands = [shlex.split(command) for _, command in next_steps(made, page) if command]
    assert commands and all(command[0] == "openjax" for command in commands)
    named = {w for c in commands for w in c[2:] if "/" in w or w.endswith(".toml")}
    assert named and all((page / word).exists() for word in named)


def test_a_headline_says_what_its_chart_shows():
    small = report("effect", ["rotor_x"], ["rotor_x"])
    rest = {"effects": {"rotor_x": Share(0.03, (0.02, 0.05))}, "sensors": Share(0.04, (0.0, 0.1))}
    parts = dataclasses.replace(small.shares, **rest, unexplained=Share(0.93, (0.9, 0.95)))
    words = dataclasses.replace(small, shares=parts).headline()
    assert "is 93 % unexplained; the named part is rotor x (3 %)" in words and "mostly" not in words


def test_a_constant_error_counts_whole():
    time = 0.01 * np.arange(300)
    late = Course("a", time, 1.0 + 0 * time, 0.1 + 0 * time, "motors all", "")
    assert late.ratio == pytest.approx(10.0) and rms(late.with_effects) == pytest.approx(0.1)


def test_a_normal_flight_is_not_charted_as_a_gap():
    assert shares(CASES["none"]) == []
    assert CASES["none"].headline().startswith("The simulator agrees")
    assert "y or z (20 %)" in CASES["two"].headline()
    assert (
        "rotor x (70 %)" in CASES["effect"].headline()
        and "shrink by 70 %" in CASES["effect"].headline()
    )


@pytest.mark.parametrize("name", list(CASES))
def test_page_is_whole_and_says_each_share_once(name):
    page = page_of(CASES[name])
    assert page.count("<h1>") == 1 and page.rstrip().endswith("</html>")
    assert "http" not in page
    assert page.count('<div class="share">') == len(shares(CASES[name]))


def test_what_was_left_out_stands_above_the_answer():
    left_out = [{"flight": "torn.csv", "issue": "no column t", "left_out": True}]
    page = page_of(report("effect", ["x"], ["x"], quality=left_out))
    assert page.index("Left out: torn.csv: no column t") < page.index("Shares of the gap")


def test_an_interval_that_holds_no_effect_is_told():
    """As where flights of two vehicles stand in one folder: one name, and no size of it
    that suits all.
    """
    parameters = {"x": {"size": Estimate(1.0, "N", (-0.5, 2.5), (0.0, 2.0), may_be_none=True)}}
    told = dataclasses.replace(report("effect", ["x"], ["x"]), parameters=parameters).in_words()
    assert any("Flights disagree about x" in line for line in told)
    assert not any("disagree" in line for line in CASES["effect"].in_words())

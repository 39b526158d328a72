"""Every result in the README is what a committed result file says."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.paper.values import means
from openjax.pursuit import SCENARIOS, PursuitSettings

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def read(name):
    return json.loads(
        (ROOT / "experiments" / "results" / f"{name}.json").read_text(encoding="utf-8")
    )


def short(value, digits):
    """A rate as the README writes it: .013, 1.00."""
    return f"{value:.{digits}f}".removeprefix("0")


def cells(label):
    """The cells of the README's only table row that begins with `label`."""
    rows = [line for line in README.splitlines() if line.startswith(f"| {label} |")]
    assert len(rows) == 1, (label, rows)
    return [cell.strip() for cell in rows[0].strip("|").split("|")][1:]


@pytest.mark.parametrize("layout", list(SCENARIOS))
def test_layouts(layout):
    """Mean over the shipped seeds, in the game that they were trained in."""
    seeds = read("headline")["records"]["clamp, drawn starts"].values()
    records = [next(r for r in records if r["scenario"] == layout) for records in seeds]
    assert len(records) == 3 and all(record["episodes"] == 100 for record in records)

    def mean(field):
        return float(np.mean([record[field] for record in records]))

    paper = "–"
    if of_paper := means(layout, "OPEN"):
        rate, step, collisions = of_paper
        paper = f"{short(rate, 3)}, {step}, {short(collisions, 3)}"
    assert cells(layout) == [
        short(mean("capture_rate"), 2),
        f"{mean('capture_step'):.0f}",
        short(mean("collision_rate"), 4),
        short(mean("crash_rate"), 3),
        paper,
    ]


def test_training_runs():
    """The slowest whole run by the preset's default settings."""
    runs = [run for run in read("seconds")["runs"] if run.get("whole")]
    seconds = [run["whole"]["seconds"] for run in runs if run["kept"] == "nothing"]
    assert len(seconds) == 5
    label = "a whole training run on one H100 (preset `paper`), nothing compiled before, the slowest of five"
    assert cells(label)[0] == f"{max(seconds):.0f} s"


def test_first_runs():
    """Of the runs by today's recipe of the preset `quick`."""
    runs = [run for run in read("quick")["runs"] if "recipe" not in run]
    assert (len(runs), len({run["seed"] for run in runs})) == (10, 5)
    least = min(
        row["capture_rate"] for run in runs for row in run["after"] if row["scenario"] in SCENARIOS
    )
    label = "ten first runs on two cores (preset `quick`): the least captures of a layout"
    assert cells(label)[0] == short(least, 2)


def test_slower_vehicle():
    """Mean crash rate over the six layouts."""
    layouts = read("vehicles")["policies"]["flight"]["table"]
    crashes = np.mean([layouts[name]["crash_rate"] for name in SCENARIOS])
    label = "a slower Crazyflie without clamp: crash rate of `flight`"
    assert cells(label)[0] == short(crashes, 3)


OUTSIDE = read("evaders_outside")["rows"]
JUDGED = read("judged")["rows"]
PLACES = (*SCENARIOS, "uniform")


@pytest.mark.parametrize("row", OUTSIDE, ids=[row["evader"] for row in OUTSIDE])
def test_evaders_from_outside(row):
    """The least capture rates that somebody else measured, on the page of evaders."""
    rates = [short(row["capture_rate"][place], 2) for place in PLACES]
    line = f"| {row['evader']} | {' | '.join(rates)} |"
    assert line in (ROOT / "experiments/results/evaders.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", ["README.md", "docs/model_cards.md"])
def test_the_second_judge(page):
    """What evaders find that trained nobody: before all other results, and on the
    policy's card.
    """
    text = (ROOT / page).read_text(encoding="utf-8")
    part = text.partition("<!-- judged -->")[2].partition("<!-- end of judged -->")[0]
    for row in JUDGED:
        rates = [short(row["capture_rate"][place], 2) for place in PLACES]
        line = f"| {row['policy']} | {row['judge']} | {' | '.join(rates)} |"
        assert (line in part) == row["shown"], line
    assert text.index("<!-- judged -->") < text.find("| layout |", text.index("judged -->")) or (
        page != "README.md"
    )


def test_the_least_of_the_second_judge():
    """Of evaders that learned and of one that plans, whichever is caught less."""
    rates = [
        row["capture_rate"]
        for row in JUDGED
        if row["policy"] == "evaders" and row["judge"] in ("evaders that learn", "a planner")
    ]
    assert len(rates) == 2
    least = min(rate[layout] for rate in rates for layout in SCENARIOS)
    uniform = min(rate["uniform"] for rate in rates)
    label = (
        "evaders that learned against `evaders`, and one that plans: the least capture "
        "rate of a layout; on uniform tasks"
    )
    assert cells(label)[0] == f"{short(least, 2)}; {short(uniform, 2)}"


def test_where_a_theorem_forces_a_capture():
    """Means over the squares of the map below its solid line, but for reaches at which
    a planner dodges.
    """
    squares = [
        square
        for square in read("catch_map")["maps"]["empty"]["cells"]
        if square["speed_ratio"] < square["forced_below"] and square["capture_radius"] >= 0.2
    ]
    rates = [
        np.mean([square[who]["capture_rate"] for square in squares if who in square])
        for who in ("learned", "planner")
    ]
    label = (
        "where a theorem forces points to catch, reach .2 m or more: captures by "
        "`teams` of evaders that learned; that plan"
    )
    assert cells(label)[0] == "; ".join(short(rate, 2) for rate in rates)


def test_diagnosis():
    """The last three sealed seeds, without a reference, each answered once."""
    seeds = read("exam_reference")["sealed_2309_to_2311"]
    first = seeds["figures"]["alone"]["first"]
    label = "diagnosis of 188 simulated cases with one cause: the first cause named is right"
    assert first["n"] == 188
    assert cells(label)[0] == short(first["hits"] / first["n"], 2)


def test_the_game():
    """The numbers of the paper's game are the settings' defaults."""
    game = PursuitSettings()
    seconds = game.episode_length * game.time_step
    pillars = f"{game.min_pillars} to {game.max_pillars} pillars"
    row = (
        f"| radius {short(game.arena_radius, 1)} m, height {game.arena_height} m, {pillars} "
        f"| {game.num_pursuers}, up to {game.max_speed:g} m/s | {game.evader_speed} m/s, a moving "
        "point "
        f"| within {short(game.capture_radius, 1)} m, in {seconds:.0f} s | thrust and body rates, "
        f"{1 / game.time_step:.0f} Hz |"
    )
    assert row in README

"""Every result in the README is what a committed result file says."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.paper.values import means
from openjax.pursuit import SCENARIOS, PursuitSettings
from openjax.pursuit.evaders import SCRIPTED

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
    """Seconds, captures and crashes of the whole runs by the preset's default settings, and the
    steps per second of updates.
    """
    runs = [run for run in read("seconds")["runs"] if run.get("whole")]
    assert len(runs) == 8

    def ends(numbers, digits):
        return " to ".join(short(end(numbers), digits) for end in (min, max))

    seconds = [
        f"{ends([r['whole']['seconds'] for r in runs if r['kept'] == kept], 0)} s"
        for kept in ("nothing", "all")
    ]
    label = (
        "whole training runs on one H100 (preset `paper`): nothing compiled before, programs kept"
    )
    assert cells(label)[0] == ", ".join(seconds)
    rates = [layout for run in runs for layout in run["whole"]["layouts"].values()]
    value = cells("... these eight seeds in the six layouts: captures, crashes")[0]
    assert value == ", ".join(ends([rate[figure] for rate in rates], 2) for figure in (0, 1))
    speeds = [run["steps_per_second"] / 1e6 for run in runs]
    assert (
        cells("environment steps per second of their updates")[0]
        == f"{np.median(speeds):.1f} million"
    )


def test_first_runs():
    """Least and most of the runs by today's recipe of the preset `quick`."""
    runs = [run for run in read("quick")["runs"] if "recipe" not in run]
    tables = [{row["scenario"]: row for row in run["after"]} for run in runs]

    for table in tables:
        table["worst"] = min(
            (table[name] for name in SCENARIOS), key=lambda row: row["capture_rate"]
        )
    for table, run in zip(tables, runs, strict=True):
        table["finely"] = run["every_physics_step"]

    def range_of(kind, figure):
        rates = sorted(short(table[kind][figure], 2) for table in tables)
        return " to ".join(dict.fromkeys((rates[0], rates[-1])))

    assert (len(runs), len({run["seed"] for run in runs})) == (10, 5)
    label = "first runs on two cores (preset `quick`, five seeds on two machines): captures of new tasks, of the worst layout"
    assert cells(label)[0] == ", ".join(
        range_of(kind, "capture_rate") for kind in ("validation", "worst")
    )
    label = (
        "... crashes in new tasks, in every step of the physics; among the six pillars of `random`"
    )
    assert cells(label)[0] == ", ".join(
        range_of(kind, "crash_rate") for kind in ("finely", "random")
    )


def test_training_step():
    """The default network, the preset's number of worlds."""
    rows = read("faster_step")["rows"]
    (row,) = [
        r for r in rows if r["run"] == "today" and r["label"] == "training" and r["worlds"] == 5120
    ]
    assert cells("the training step alone")[0] == f"{row['sps'] / 1e6:.1f} million"


def test_slower_vehicle():
    """Mean crash rate over the six layouts."""
    policies = read("vehicles")["policies"]
    crashes = [
        np.mean([policies[name]["table"][layout]["crash_rate"] for layout in SCENARIOS])
        for name in ("flight", "open")
    ]
    value = cells("a slower Crazyflie without clamp: crash rate of `flight`, of `open`")[0]
    assert value == f"{short(crashes[0], 3)}, {short(crashes[1], 2)}"


def test_evaders():
    """Captures of the paper's evader and of the least favourable scripted one, by two policies."""
    rates = {
        (r["policy"], r["evader"], r["tasks"]): r["capture_rate"]
        for r in read("evaders")["records"]
        if (r["game"], r["vehicle"]) == ("honest", "nominal")
    }

    def least(evaders, places):
        return ", ".join(
            short(min(rates[policy, e, place] for e in evaders for place in places), 2)
            for policy in ("flight", "evaders")
        )

    label = "new tasks without clamp, captures by `flight`, by `evaders`: the paper's evader"
    assert cells(label)[0] == least(["field"], ["uniform"])
    assert cells("... of twelve scripted evaders the one that suits the team least")[0] == least(
        SCRIPTED, ["uniform"]
    )
    assert cells("... the worst pair of an evader and a layout")[0] == least(SCRIPTED, SCENARIOS)
    assert len(SCRIPTED) == 12


OUTSIDE = read("evaders_outside")["rows"]


@pytest.mark.parametrize("row", OUTSIDE, ids=[row["evader"] for row in OUTSIDE])
def test_evaders_from_outside(row):
    """The least capture rates that somebody else measured, in the README and on the page of evaders,
    before everything else that either says of results.
    """
    rates = [short(row["capture_rate"][place], 2) for place in (*SCENARIOS, "uniform")]
    assert cells(row["evader"]) == rates
    page = (ROOT / "experiments" / "results" / "evaders.md").read_text(encoding="utf-8")
    line = f"| {row['evader']} | {' | '.join(rates)} |"
    assert line in page
    results = README[README.index("## Results") :]
    assert results.index(line) < results.index("| layout |")


@pytest.mark.parametrize(
    ("label", "names"),
    [
        (
            "diagnosis of 120 simulated cases drawn afterwards: first cause named is right (64 "
            "with one cause)",
            ["first"],
        ),
        ("... nothing else is named", ["nothing_else"]),
        (
            "... a cause that no model covers is called unknown, gets a wrong name (14 cases)",
            ["unknown", "wrong_name"],
        ),
        ("... a named effect acts, and unknown is said", ["false_unknown"]),
        ("... nothing acts, and nothing is named", ["none"]),
    ],
)
def test_diagnosis(label, names):
    figures = read("exam")["columns"]["stranger"]["figures"]
    assert (figures["traceback"]["n"], figures["unknown"]["n"]) == (120, 14)
    assert cells(label)[0] == ", ".join(short(figures[name]["value"], 2) for name in names)


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

"""Figures that several pages show, each from one stored result: `python -m experiments.figures`
writes them.

A page has a block between `<!-- NAME -->` and `<!-- end of NAME -->`; `BLOCKS` has its text,
computed from `experiments/results/*.json`. `tests/test_readme_numbers.py` fails while a page shows
anything else.
"""

import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.paper.values import means
from experiments.table import RESULTS, table
from openjax.command_line import run_command
from openjax.files import read_json, read_toml, write_text
from openjax.pursuit import SCENARIOS, PursuitSettings
from openjax.store import DEFAULT_POLICY

ROOT = Path(__file__).parents[1]
LEARNED, PLANNER = "evaders that learn", "a planner"
"""The two judges of a policy that find most."""
JUDGES = {
    LEARNED: "evaders that learned against it",
    PLANNER: "an evader that plans in the true simulation",
    "scripted ones, held out": "scripted evaders, held out of training",
    "the paper's": "the paper's evader",
}
WIDTH = 100
PLACES = (*SCENARIOS, "uniform")


def read(name: str) -> dict:
    """A stored result."""
    return read_json(RESULTS / f"{name}.json")


def rates(policy: str, judge: str) -> dict[str, float]:
    """By layout, and on uniform tasks: capture rate of the evader that is caught least."""
    rows = [
        row for row in read("judged")["rows"] if (row["policy"], row["judge"]) == (policy, judge)
    ]
    (row,) = [row for row in rows if row["vehicle"] == "nominal"]
    return row["capture_rate"]


def curve(policy: str) -> list[dict]:
    """What it catches over the steps of evaders that learn against it."""
    return read("judged")["curves"][f"{policy}, nominal"]


def billions(point: dict) -> str:
    """Steps of each learner."""
    return f"{point['steps'] / 1e9:.2g}"


def worst(rate: dict[str, float]) -> float:
    """The least of the six layouts."""
    return min(rate[layout] for layout in SCENARIOS)


def linked(words: str, page: str) -> str:
    """Words that lead to a page of results."""
    return f"[{words}](experiments/results/{page}.md)"


def judged() -> str:
    """The default policy against each kind of evader, by layout."""
    rows = []
    for judge, told in JUDGES.items():
        rate = rates(DEFAULT_POLICY, judge)
        rows.append([told, *(f"{rate[place]:.2f}" for place in PLACES)])
    return "\n".join(table(["hardest evader among", *PLACES], rows))


def members() -> str:
    """Why the default policy is two: each member alone against evaders that learned."""
    alone = [worst(rates(f"{DEFAULT_POLICY}, member {n}", LEARNED)) for n in (1, 2)]
    first = curve(DEFAULT_POLICY)[0]
    both = worst(first["capture_rate"])
    return textwrap.fill(
        f"`{DEFAULT_POLICY}` is two policies, and the team switches between them at random every "
        f"0.4 s. Against evaders that learned {billions(first)} billion steps each, it catches "
        f"{both:.2f} in the worst layout. Alone, and against evaders of fewer steps, its two "
        f"members catch {alone[0]:.2f} and {alone[1]:.2f}.",
        WIDTH,
    )


def hold() -> str:
    """How often the default policy catches the hardest evaders."""
    points = curve(DEFAULT_POLICY)
    first, last = (point["capture_rate"] for point in (points[0], points[-1]))
    planner = rates(DEFAULT_POLICY, PLANNER)
    return textwrap.fill(
        f"`{DEFAULT_POLICY}` catches the hardest evader that learned against it for "
        f"{billions(points[0])} billion steps in {first['uniform']:.2f} of uniform tasks, and in "
        f"{worst(first):.2f} of the episodes of its worst layout. After {billions(points[-1])} "
        f"billion steps it is {last['uniform']:.2f} and {worst(last):.2f}. It catches an evader "
        f"that plans in the true simulation in {planner['uniform']:.2f} of uniform tasks, and in "
        f"{worst(planner):.2f} of its worst layout.",
        WIDTH,
    )


def paper_game() -> tuple[list[str], list[str]]:
    """Rows on `open` in the paper's game: captures of the worst layout, and steps to the capture
    beside the paper's.
    """
    seeds = read("headline")["records"]["clamp, drawn starts"].values()
    flown = {
        layout: [r for own in seeds for r in own if r["scenario"] == layout] for layout in SCENARIOS
    }
    assert all(len(records) == 3 for records in flown.values())

    def mean(layout: str, field: str) -> float:
        return float(np.mean([record[field] for record in flown[layout]]))

    shared = [layout for layout in SCENARIOS if means(layout, "OPEN")]
    steps = np.mean([mean(layout, "capture_step") for layout in shared])
    paper = np.mean([means(layout, "OPEN")[1] for layout in shared])
    captures = min(mean(layout, "capture_rate") for layout in SCENARIOS)
    game = linked("The paper's game, three seeds of `open`", "headline")
    return (
        [f"{game}: captures, worst of six unseen layouts", f"{captures:.2f}"],
        [
            f"{game}: mean steps to a capture, the paper's {len(shared)} layouts",
            f"{steps:.0f} (paper: {paper:.0f})",
        ],
    )


def whole_runs() -> list[str]:
    """The slowest whole run of the preset `paper`, with nothing compiled before."""
    runs = [run for run in read("seconds")["runs"] if run.get("whole") and run["kept"] == "nothing"]
    seconds = [run["whole"]["seconds"] for run in runs]
    assert len(seconds) == 5
    told = linked("Training on one H100", "seconds")
    return [f"{told}, nothing compiled before: slowest of five runs", f"{max(seconds):.0f} s"]


def first_runs() -> list[str]:
    """The least captures of the preset `quick` on two cores, by today's recipe."""
    runs = [run for run in read("quick")["runs"] if "recipe" not in run]
    assert (len(runs), len({run["seed"] for run in runs})) == (10, 5)
    records = [row for run in runs for row in run["after"] if row["scenario"] in SCENARIOS]
    told = linked("Training on two CPU cores", "quick")
    least = min(row["capture_rate"] for row in records)
    return [f"{told}, preset `quick`: captures, worst layout of ten runs", f"{least:.2f}"]


def judged_rows() -> list[list[str]]:
    """The default policy against the two hardest kinds of evaders."""
    rows = []
    for judge in (LEARNED, PLANNER):
        rate = rates(DEFAULT_POLICY, judge)
        told = linked(f"`{DEFAULT_POLICY}` against {JUDGES[judge]}", "judged")
        for place, value in (("worst layout", worst(rate)), ("uniform tasks", rate["uniform"])):
            rows.append([f"{told}: captures, {place}", f"{value:.2f}"])
    return rows


def slower_vehicle() -> list[str]:
    """Mean crash rate of `flight` over the six layouts."""
    layouts = read("vehicles")["policies"]["flight"]["table"]
    crashes = np.mean([layouts[name]["crash_rate"] for name in SCENARIOS])
    told = linked("`flight` on a slower Crazyflie", "vehicles")
    return [f"{told}, without the speed clamp: crashes", f"{crashes:.3f}"]


def forced() -> list[str]:
    """Captures of `teams` where a theorem forces points to catch, at reaches at which no planner
    dodges.
    """
    squares = [
        square["learned"]["capture_rate"]
        for square in read("catch_map")["maps"]["empty"]["cells"]
        if square["speed_ratio"] < square["forced_below"] and square["capture_radius"] >= 0.2
        if "learned" in square
    ]
    told = linked("`teams` where points can force a capture", "catch_map")
    return [f"{told}, reach 0.2 m or more: captures", f"{np.mean(squares):.2f}"]


def diagnosis() -> list[str]:
    """The last three sealed seeds, without a reference, each answered once."""
    first = read("exam_reference")["sealed_2309_to_2311"]["figures"]["alone"]["first"]
    told = linked(f"Diagnosis of {first['n']} simulated cases with one cause", "exam_reference")
    return [f"{told}: right cause first", f"{first['hits'] / first['n']:.2f}"]


def results() -> str:
    """The README's table."""
    rows = [whole_runs(), first_runs(), *paper_game(), *judged_rows(), slower_vehicle(), forced()]
    return "\n".join(table(["What was measured", "Result"], [*rows, diagnosis()]))


def game() -> str:
    """The paper's game, as the settings' defaults have it."""
    own = PursuitSettings()
    row = [
        f"radius {own.arena_radius} m, height {own.arena_height} m, "
        f"{own.min_pillars} to {own.max_pillars} pillars",
        f"{own.num_pursuers}, up to {own.max_speed:g} m/s",
        f"{own.evader_speed} m/s, a point",
        f"within {own.capture_radius} m, in {own.episode_length * own.time_step:.0f} s",
        f"thrust and body rates, {1 / own.time_step:.0f} Hz",
    ]
    return "\n".join(table(["arena", "pursuers", "evader", "capture", "commands"], [row]))


def address() -> str:
    """The repository's, as pyproject.toml has it."""
    return read_toml(ROOT / "pyproject.toml")["project"]["urls"]["Repository"]


def colab(tutorial: str) -> str:
    """Where a tutorial runs as a notebook; `docs/make_notebooks.py` makes it."""
    place = address().removeprefix("https://github.com/")
    notebook = f"{place}/blob/main/docs/notebooks/{tutorial}.ipynb"
    return f"[Run it in Colab](https://colab.research.google.com/github/{notebook})."


def clone() -> str:
    """The commands that install."""
    commands = (
        (f"git clone {address()} openjax && cd openjax", ""),
        ("make train", "installs into .venv, trains a team, shows what it learned"),
        (". .venv/bin/activate", "makes `openjax` a command"),
    )
    lines = [f"{command:27} # {told}" if told else command for command, told in commands]
    return "\n".join(["```", *lines, "```"])


BLOCKS: dict[str, Callable[[], str]] = {
    "clone": clone,
    "results": results,
    "judged": judged,
    "members": members,
    "hold": hold,
    "game": game,
    "colab_own_game": lambda: colab("own_game"),
    "colab_log_to_cause": lambda: colab("log_to_cause"),
}
PAGES = (
    "README.md",
    "docs/how_it_works.md",
    "docs/model_cards.md",
    "docs/questions.md",
    "docs/start.md",
    "docs/tutorials/log_to_cause.md",
    "docs/tutorials/own_game.md",
    "experiments/results/judged.md",
)


def rendered(text: str) -> str:
    """A page's text with today's figures."""
    for name, block in BLOCKS.items():
        before, begin, rest = text.partition(f"<!-- {name} -->\n")
        _, end, after = rest.partition(f"<!-- end of {name} -->")
        if begin:
            assert end, f"no end of {name}"
            text = before + begin + block() + "\n" + end + after
    return text


def main(_: list[str]) -> None:
    """Write the blocks of all pages."""
    for name in PAGES:
        path = ROOT / name
        write_text(path, rendered(path.read_text(encoding="utf-8")))


if __name__ == "__main__":
    run_command(main)

"""The README's commands: each exists, and the way from sample flights to a corrected
simulator works as written.
"""

import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import openjax
from openjax.__main__ import COMMANDS
from openjax.commands import calibrate, diagnose, sample_flights
from openjax.learning import TrainSettings
from openjax.plain import from_plain
from openjax.store import DEFAULT_POLICY, TEAM_POLICY
from openjax.store.environments import make_environment
from openjax.store.policy_files import WEIGHTS, load_policy_file
from openjax.vehicle.vehicle_file import load_vehicle_file
from tests.test_commands import ALONE, STEPS, TINY

ROOT = Path(__file__).parents[1]
OTHER_RECIPE = "isn't the preset's recipe of today"
"""What a model card says of weights that the preset wouldn't make again."""
README = (ROOT / "README.md").read_text(encoding="utf-8")
# folders that building the site leaves
MADE = ("_build", "generated", "jupyter_execute", "measured")
PAGES = [path for path in sorted((ROOT / "docs").rglob("*.md")) if not set(MADE) & set(path.parts)]


def test_every_command_and_target_of_the_readme_exists():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"(?:^|`)make ([a-z]+)\b", README, re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    code = re.findall(r"^```.*?^```|`[^`\n]+`", README + pages, re.MULTILINE | re.DOTALL)
    commands = set(re.findall(r"(?:^ *|`)openjax ([a-z]\w+)", "\n".join(code), re.MULTILINE))
    assert commands == set(COMMANDS), commands ^ set(COMMANDS)


def test_what_the_readmes_commands_write_is_ignored():
    """Nobody who tries them finds his outputs among the changes of the repository."""
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()
    pages = README + (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    written = set(re.findall(r"(?:--out|sample_flights) ([a-z][\w/.]+)", pages))
    assert {"runs/mine", "flights"} <= written
    for path in written:
        first = path.partition("/")[0]
        assert {f"/{first}/", f"/{first}"} & set(ignored), path


def test_modules_that_the_pages_run_are_there():
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES):
        for name in re.findall(r"python -m ([a-z_.]+)", page.read_text(encoding="utf-8")):
            assert importlib.util.find_spec(name.rstrip(".")), f"{page.name}: {name}"


def test_readme_and_pages_stay_short():
    """README 800 words, all pages of the documentation 13,100; a word has a letter,
    and what the API page lists of the code is no prose.
    """

    def words(text):
        text = re.sub(r"^```{eval-rst}.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
        return len(re.findall(r"\S*[^\W\d_]\S*", text))

    assert words(README) <= 800
    assert sum(words(page.read_text(encoding="utf-8")) for page in PAGES) <= 13_100


def test_links_lead_somewhere():
    """To a file, and where a page is named with a heading, to that heading.

    The site shows a copy of the pages of results: their links stay among them and the
    site's pages.
    """
    results = ROOT / "experiments" / "results"
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES, *results.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        for path, heading in re.findall(r"\]\((?!http)([^)#]*)#?([^)]*)\)", text):
            target = page.parent / path if path else page
            assert target.exists(), f"{page.name}: {path}"
            if results in page.parents:
                assert {ROOT / "docs", results} & set(target.resolve().parents), (
                    f"{page.name}: {path}"
                )
            if heading:
                titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
                assert heading in [title.lower().replace(" ", "-") for title in titles], (
                    f"{page.name}: {heading}"
                )


def test_the_table_of_experiments_names_them_all():
    page = (ROOT / "experiments" / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:\w+\.)*\w+)`", page))
    commands = {
        path.relative_to(ROOT / "experiments")
        .with_suffix("")
        .as_posix()
        .replace("/", ".")
        .removesuffix(".__main__")
        for path in (ROOT / "experiments").rglob("*.py")
        if 'if __name__ == "__main__"' in path.read_text(encoding="utf-8")
    }
    there = {name for name in commands if not name.startswith("diagnosis.")}
    assert there <= named, there - named
    for path in re.findall(r"\]\(([^)#]+)\)", page):
        assert (ROOT / "experiments" / path).exists(), path


def test_modules_that_the_pages_name_are_there():
    modules = [
        path.relative_to(ROOT).as_posix()
        for part in ("src", "experiments", "examples", "tests")
        for path in (ROOT / part).rglob("*.py")
    ]
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES):
        for name in re.findall(r"`([\w/]+\.py)`", page.read_text(encoding="utf-8")):
            assert any(f"/{module}".endswith(f"/{name}") for module in modules), (
                f"{page.name}: {name}"
            )


@pytest.mark.slow
def test_python_of_the_readme_runs():
    names = {}
    exec(re.search(r"```python\n(.*?)```", README, re.DOTALL).group(1), names)
    assert names["record"]["capture_rate"] > 0.95
    assert names["observation"].position.shape == (3, 3)


@pytest.mark.slow
def test_both_doors_of_the_readme_open(tmp_path):
    """Its commands as they are written, one after the other in one folder; only a training
    is made smaller, and a page is written instead of served.
    """
    smaller = {"train": [*TINY, *STEPS, *ALONE], "view": ["--html", "chase.html"]}
    text = " ".join(README.split())
    written = dict.fromkeys(
        re.findall(
            r"openjax ((?:train|view|sample_flights|diagnose) [^`#]*?)"
            r"(?= openjax| ```|`| \.\.\.)",
            text,
        )
    )
    assert {line.partition(" ")[0] for line in written} >= {*smaller, "sample_flights", "diagnose"}
    # a flight of virtual vehicles has tests of its own
    for line in (line for line in written if "first_flight" not in line):
        command = [sys.executable, "-m", "openjax", *line.split()]
        command += smaller.get(line.partition(" ")[0], [])
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (line, done.stderr)
    for path in ("runs/mine/policy.npz", "chase.html", "diagnosis/flights/report.html"):
        assert (tmp_path / path).is_file(), path


@pytest.mark.slow
@pytest.mark.usefixtures("ruled_reports")
def test_from_sample_flights_to_a_corrected_simulator(tmp_path):
    """sample_flights -> calibrate -> diagnose -> an environment that flies with what
    was found.
    """
    case = tmp_path / "drag"
    out = tmp_path / "diagnosis"
    sample_flights.main([str(case), "--effect", "rotor_drag"])
    calibrate.main([str(case), "--out", str(tmp_path / "vehicle_calibrated.toml")])
    vehicle = load_vehicle_file(tmp_path / "vehicle_calibrated.toml").vehicle
    nominal = load_vehicle_file(case).vehicle
    assert (
        abs(float(vehicle.thrust_constant / nominal.thrust_constant) - 1) < 0.05
    )  # nothing was wrong with it

    assert diagnose.main([str(case), "--out", str(out), "--no-html"]) == 0
    report = json.loads((out / "drag" / "report.json").read_text(encoding="utf-8"))
    assert report["verdict"] == "effect"
    assert "rotor_drag" in report["effects"]
    assert report["gap"]["reduction"] > 0.5
    # what the README prints is what is found
    (value,) = re.findall(r"d_xy = ([\d.]+) \[", README)
    assert abs(report["parameters"]["rotor_drag"]["d_xy"]["value"] / float(value) - 1) < 0.02
    (share,) = re.findall(r"Shares of the gap: rotor_drag ([\d.]+) \[", README)
    assert abs(report["shares"]["effects"]["rotor_drag"]["value"] - float(share)) < 0.03

    settings = openjax.PursuitSettings(physics="rigid", speed_limit="none")
    corrected = make_environment(settings, None, out / "drag" / "effects.toml")
    action = jnp.zeros((3, 4)).at[:, 0].set(0.25).at[:, 2].set(0.2)

    def speed_after_a_second(environment):
        step = jax.jit(environment.step)
        _, state = jax.jit(environment.reset)(jax.random.key(0))
        for _ in range(100):
            _, state, *_ = step(jax.random.key(0), state, action)
        return float(jnp.mean(jnp.linalg.norm(state.drones.velocity, axis=-1)))

    # the same commands fly slower against the drag that was found
    assert speed_after_a_second(corrected) < 0.97 * speed_after_a_second(openjax.Pursuit(settings))


@pytest.mark.parametrize("name", [DEFAULT_POLICY, TEAM_POLICY])
def test_default_policies_play_todays_game_and_a_card_names_another_recipe(name):
    """What ships was trained by the recipe that its card names, for the preset's game."""
    stored = load_policy_file(WEIGHTS / f"{name}.npz")[1]
    shipped = from_plain(TrainSettings, stored, f"{name}: ")
    todays = openjax.preset(name, seed=shipped.seed)
    # a member's, of which the team draws one; evaders that learned are in no file
    game = dataclasses.replace(
        todays.environment,
        evaders=shipped.environment.evaders,
        strategies=shipped.environment.strategies,
        strategy_seconds=shipped.environment.strategy_seconds,
    )
    assert shipped.environment == game
    assert shipped.network == todays.network
    cards = (ROOT / "docs/model_cards.md").read_text(encoding="utf-8")
    card = cards.partition(f"## `{name}`")[2].partition("\n## ")[0]
    card = " ".join(card.split())
    is_todays = dataclasses.replace(shipped, environment=todays.environment) == todays
    assert is_todays == (OTHER_RECIPE not in card)

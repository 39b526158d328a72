"""The examples run, are short, and end with what they promise."""

import dataclasses
import json
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import openjax
from openjax.show.metrics import read_metrics

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[1] / "examples"
RULED = """
import runpy, sys
report = runpy.run_path(sys.argv[1])["report"]
from openjax.gap.report.rules import broken_rules
assert not (broken := broken_rules(report)), broken
"""


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_example_is_short(path):
    assert len(path.read_text().splitlines()) <= 40


def test_own_game_captures(capsys):
    runpy.run_path(str(EXAMPLES / "own_game.py"))
    captured = int(capsys.readouterr().out.split("captured in ")[1].split()[0])
    assert captured >= 32  # of 64: the controller of the example flies


def test_own_controller_is_flown_like_a_policy(capsys):
    runpy.run_path(str(EXAMPLES / "own_controller.py"))
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    captured = {name: float(row[2].rstrip(",")) for name, row in rows.items()}
    assert captured["open"] == 1.0  # the shipped policy, in the same game
    # running after a faster one isn't enough
    assert captured["slower"] > 0.9 > captured["faster"]


@pytest.fixture
def tiny_preset(tmp_path, monkeypatch):
    """`openjax.preset` gives a run of two updates, whatever it is asked for; in a
    folder of its own.
    """
    tiny = openjax.preset("quick")
    tiny = dataclasses.replace(
        tiny,
        environment=dataclasses.replace(
            tiny.environment, time_step=0.01, substeps=1, episode_length=40
        ),
        network=dataclasses.replace(tiny.network, features=8, heads=1),
        predictor=dataclasses.replace(tiny.predictor, enabled=False),  # less to compile
        first_flights=dataclasses.replace(tiny.first_flights, updates=0),
        rollout_length=20,
        restart_every=0,
        num_envs=16,
        total_steps=640,
        validation_episodes=8,
    )
    monkeypatch.setattr(openjax, "preset", lambda name, **changes: tiny, raising=False)
    monkeypatch.setattr(sys, "argv", ["example.py"])
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("part", ["reward", "network", "observation", "learner"])
def test_a_part_of_ones_own_is_trained(part, tiny_preset, tmp_path, capsys):
    example = runpy.run_path(str(EXAMPLES / f"own_{part}.py"))
    printed = capsys.readouterr().out
    assert part == "learner" or "captured in" in printed
    run = tmp_path / "runs" / f"own_{part}"
    metrics = list(read_metrics(run / "metrics.jsonl", "train"))
    assert len(metrics) == 2 and (run / "chase.gif").is_file() and (run / "policy.npz").is_file()
    assert ("reinforce_loss" in metrics[0]) == (part == "learner")
    with pytest.raises(openjax.UserError, match="was begun with"):
        openjax.train(resume=run)
    if part == "network":
        assert f'openjax.load_policy("runs/own_{part}", ' in printed
        with pytest.raises(openjax.UserError, match="a network of your own: load it in Python"):
            openjax.load_policy(run)
    if part == "learner":
        longer = dataclasses.replace(example["settings"], total_steps=960)
        openjax.train(longer, resume=run, learners=example["learners"])
        metrics = list(read_metrics(run / "metrics.jsonl", "train"))
        assert [row["update"] for row in metrics] == [1, 2, 3]


def test_an_evader_of_ones_own_is_flown(capsys):
    runpy.run_path(str(EXAMPLES / "own_evader.py"), run_name="__main__")
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "caught in" in line]
    assert [row[0] for row in rows] == ["field", "foresee"]
    assert float(rows[0][3]) == 1.0


def test_training_from_python_gives_a_policy(tiny_preset, tmp_path, capsys):
    runpy.run_path(str(EXAMPLES / "train_from_python.py"))
    assert "distances to the evader" in capsys.readouterr().out
    assert (tmp_path / "runs/from_python/policy.npz").is_file()


def test_an_effect_of_ones_own_is_flown_and_named():
    """In a process of its own: effects are registered before the diagnosis is
    loaded.
    """
    command = [sys.executable, "-c", RULED, str(EXAMPLES / "own_effect.py")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    assert "tether" in done.stdout


@pytest.mark.usefixtures("ruled_reports")
def test_diagnosis_names_drag(capfd):
    runpy.run_path(str(EXAMPLES / "diagnose_flights.py"))
    assert "drag" in capfd.readouterr().out


def test_own_importer_reads_a_format_of_its_own(tmp_path, sample_columns):
    """A log of JSON lines becomes a flight of a case, once the example has registered
    its importer.
    """
    from openjax.flights.case import load_case
    from openjax.flights.importers import importer

    shipped = list(importer._IMPORTERS)
    try:
        example = runpy.run_path(str(EXAMPLES / "own_importer.py"))
        columns = sample_columns["flight_b"]
        rows = [
            {"ms": round(1e3 * float(columns["t"][k]))}
            | {
                key: [float(columns[n][k]) for n in names.split()]
                for key, names in example["COLUMNS"].items()
            }
            for k in range(300)
        ]
        text = "\n".join(json.dumps(row) for row in rows)
        (tmp_path / "first.flight.jsonl").write_text(text)
        (tmp_path / "empty.flight.jsonl").write_text("")
        (tmp_path / "vehicle.toml").write_text("")
        case = load_case(tmp_path)
    finally:
        importer._IMPORTERS[:] = shipped
    assert [flight.name for flight in case.flights] == ["first.flight.jsonl"]
    assert [issue.issue for issue in case.left_out()] == ["holds no row"]
    np.testing.assert_allclose(case.flights[0].body_rates[:, 1], columns["wy"][:300], atol=1e-9)

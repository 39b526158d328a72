"""The examples run, are short, and end with what they promise."""

import dataclasses
import runpy
import sys
from pathlib import Path

import pytest

import openjax

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[1] / "examples"


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
    assert captured["chase"] < captured["open"]  # running after a faster one isn't enough


def test_training_from_python_gives_a_policy(tmp_path, monkeypatch, capsys):
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
    monkeypatch.setattr(openjax, "preset", lambda name: tiny, raising=False)
    monkeypatch.setattr(sys, "argv", ["train_from_python.py"])
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "train_from_python.py"))
    assert "distances to the evader" in capsys.readouterr().out
    assert (tmp_path / "runs/from_python/policy.npz").is_file()


def test_diagnosis_names_drag(capfd):
    runpy.run_path(str(EXAMPLES / "diagnose_flights.py"))
    assert "drag" in capfd.readouterr().out

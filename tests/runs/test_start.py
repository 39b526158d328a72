"""What a run's settings begin with: a preset, a file, another run; from the command line and
from Python.
"""

import inspect

import pytest

import openjax
from openjax.commands.calls import train
from openjax.errors import UserError
from openjax.learning import preset
from openjax.runs.request import read_command
from openjax.runs.train_command import TrainCommand
from openjax.store.run_directory import RunDirectory


def test_a_file_changes_the_presets_settings_and_the_command_line_goes_before_it(tmp_path):
    file = tmp_path / "run.toml"
    file.write_text("num_envs = 1280\n[environment]\nevader_speed = 2.0\nmax_pillars = 3\n")
    arguments = ["--preset", "quick", "--config", str(file), "--environment.max_pillars", "2"]
    settings = read_command(arguments).settings
    game = dict(evader_speed=2.0, max_pillars=2)
    assert settings == preset("quick", num_envs=1280, environment=game)


def test_a_runs_own_settings_are_such_a_file(tmp_path):
    settings = preset("paper", seed=7, environment=dict(evader_speed=1.0))
    RunDirectory(tmp_path).write_settings(settings, {"machine": {}})
    assert read_command(["--config", str(tmp_path / "settings.json")]).settings == settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("num_env = 3", "run.toml has the unknown key 'num_env'"),
        (
            "[mappo]\nminibatches = 1.5",
            "run.toml: mappo.minibatches is 1.5; expected a whole number",
        ),
        ("mappo = 3", "run.toml: mappo is 3; expected a table"),
    ],
)
def test_a_wrong_file_is_one_line(text, message, tmp_path):
    (tmp_path / "run.toml").write_text(text)
    with pytest.raises(UserError, match=message):
        read_command(["--config", str(tmp_path / "run.toml")])


def test_a_file_does_not_change_a_run_that_goes_on(tmp_path):
    RunDirectory(tmp_path).write_settings(preset("quick"), {})
    with pytest.raises(UserError, match="--config and --resume exclude each other"):
        read_command(["--resume", str(tmp_path), "--config", "run.toml"])


def test_the_call_takes_and_shows_the_commands_options(tmp_path):
    shown = inspect.signature(train).parameters
    assert {"minutes", "start_from", "resume", "learners", "on_record"} <= set(shown)
    assert shown["overwrite"].default is TrainCommand.overwrite
    with pytest.raises(UserError, match=r"minute: .* did you mean minutes"):
        openjax.train(out=tmp_path / "run", minute=3)
    with pytest.raises(UserError, match="minutes is -1; it must be in"):
        openjax.train(out=tmp_path / "run", minutes=-1)
    assert not (tmp_path / "run").exists()

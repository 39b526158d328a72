"""Which layouts a policy flies."""

import jax
import jax.numpy as jnp
import pytest

import openjax
from openjax.command_line import parse
from openjax.commands import evaluate
from openjax.policy import make_policy
from openjax.store.policies import abstract_parameters
from openjax.store.policy_files import save_policy_file


def test_a_team_that_no_layout_was_made_for_flies_uniform_tasks():
    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    game = dict(num_pursuers=2, physics="rigid", contacts=False, episode_length=5)
    (record,) = openjax.evaluate(still, episodes=1, **game)
    assert record["scenario"] == "uniform" and record["episodes"] == 1


def test_an_evader_of_ones_own_is_flown_by_function_and_by_file(tmp_path, capsys):
    def frozen(scene, memory):
        return jnp.zeros(3), memory

    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    game = dict(num_pursuers=2, physics="rigid", contacts=False, episode_length=5)
    record = openjax.evaluate(still, "uniform", episodes=1, opponent=frozen, **game)
    shipped = openjax.evaluate(still, "uniform", episodes=1, opponent="frozen", **game)
    assert record == shipped
    # a controller learned in no game
    assert "never trained" not in capsys.readouterr().out
    file = tmp_path / "mine.py"
    file.write_text(
        "speed = 1\n\ndef frozen(scene, memory):\n    return 0.0 * scene.velocity, memory\n"
    )
    file.write_text(
        f"{file.read_text()}\ndef still(observation):\n"
        "    return 0.0 * observation.pillars[:, 0, :4]\n"
    )
    mine = openjax.load_policy(f"{file}:still")
    by_file = openjax.evaluate(mine, "uniform", episodes=1, opponent=f"{file}:frozen", **game)
    assert record == by_file
    command = evaluate.EvaluateCommand(opponent=f"{file}:frozen")
    evaluate._show(command, [(command, "still", [record])])
    # a long path is broken into lines
    said = "".join(capsys.readouterr().out.split())
    assert "theevaderis" in said and "mine.py:frozen" in said
    for name, text in (
        (f"{file}:speed", "has no function speed"),
        (f"{tmp_path}/no.py:x", "there is no file"),
    ):
        with pytest.raises(openjax.UserError, match=text):
            openjax.evaluate(still, "uniform", opponent=name, **game)


def test_a_game_that_a_policy_was_never_trained_for_is_said():
    policy = openjax.load_policy("open")
    assert policy.outside_of_training(openjax.make(policy.settings.environment)) == []
    larger = openjax.make(policy.settings.environment, arena_radius=1.5, airframe="brushless")
    assert policy.outside_of_training(larger) == [
        "arena_radius 1.5 instead of 0.9",
        "the brushless instead of the crazyflie",
    ]
    assert openjax.load_policy("apf").outside_of_training(larger) == []


def test_a_policy_for_teams_flies_with_any_number(tmp_path, capsys):
    game = dict(physics="rigid", contacts=False, episode_length=5, evaders=("field",), substeps=1)
    small = dict(
        network=dict(features=8),
        predictor=dict(units=4, horizons=(1, 2), windows=2),
        mappo=dict(step_subsampling=1),
        rollout_length=5,
        restart_steps=5,
    )
    settings = openjax.preset("teams", environment=game, **small)
    environment = openjax.Pursuit(settings.environment)
    policy = make_policy(environment, settings.network, settings.predictor)
    kinds = abstract_parameters(environment, policy)
    parameters = jax.tree.map(lambda kind: jnp.zeros(kind.shape), kinds)
    save_policy_file(tmp_path / "teams.npz", parameters, settings, {}, storage="float32")
    loaded = openjax.load_policy(tmp_path / "teams.npz")
    record = openjax.evaluate(loaded, "uniform", episodes=2, num_pursuers=5, evader_speed=1.9)
    assert record["episodes"] == 2 and record["crash_rate"] is not None
    said = " ".join(capsys.readouterr().out.split())
    assert "never trained for this: 5 pursuers, which no team in training had" in said
    pair = loaded.of_team(2)
    seen = jax.eval_shape(openjax.make(pair.settings.environment).reset, jax.random.key(0))[0]
    assert jax.eval_shape(pair, seen).shape == (2, 4)


def test_where_none_is_named_a_policy_flies_that_takes_so_many(tmp_path, capsys):
    layout = tmp_path / "pair.toml"
    layout.write_text("pursuers = [[0.3, 0.0, 0.6], [0.3, 0.3, 0.6]]\nevader = [-0.3, 0.0, 0.6]\n")
    arguments = {
        (): "evaders",
        ("--num_pursuers", "5", "--scenario", "uniform"): "teams",
        ("--environment.num_pursuers", "2"): "teams",
        ("--environment.evader_speed", "2", "--scenario", "uniform"): "teams",
        ("--scenario", str(layout)): "teams",
        ("--num_pursuers", "5", "--scenario", "uniform", "--policy", "flight"): None,
    }
    for typed, name in arguments.items():
        command = parse(evaluate.EvaluateCommand, evaluate.EvaluateCommand(), typed, "evaluate")
        if name is None:
            with pytest.raises(openjax.UserError, match="num_pursuers 3"):
                evaluate.prepare(command, typed)
            continue
        ((_, loaded),) = evaluate.prepare(command, typed)
        assert loaded.source == name
        said = " ".join(capsys.readouterr().out.split())
        assert ("policy teams: evaders knows" in said) == (name == "teams")

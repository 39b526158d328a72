"""Which layouts a policy flies."""

import jax.numpy as jnp
import pytest

import openjax


def test_a_team_that_no_layout_was_made_for_flies_uniform_tasks():
    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    game = dict(num_pursuers=2, physics="rigid", contacts=False, episode_length=5)
    (record,) = openjax.evaluate(still, episodes=1, **game)
    assert record["scenario"] == "uniform"
    assert record == openjax.evaluate(still, "uniform", episodes=1, **game)


def test_an_evader_of_ones_own_is_flown_by_function_and_by_file(tmp_path, capsys):
    def frozen(scene, memory):
        return jnp.zeros(3), memory

    def still(observation):
        return jnp.zeros((observation.position.shape[0], 4))

    game = dict(num_pursuers=2, physics="rigid", contacts=False, episode_length=5)
    record = openjax.evaluate(still, "uniform", episodes=1, opponent=frozen, **game)
    shipped = openjax.evaluate(still, "uniform", episodes=1, opponent="frozen", **game)
    assert record == shipped
    assert "never trained" not in capsys.readouterr().out  # a controller learned in no game
    file = tmp_path / "mine.py"
    file.write_text(
        "speed = 1\n\ndef frozen(scene, memory):\n    return 0.0 * scene.velocity, memory\n"
    )
    assert record == openjax.evaluate(
        still, "uniform", episodes=1, opponent=f"{file}:frozen", **game
    )
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

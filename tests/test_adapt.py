"""From flights to a fine-tuned policy, at a tiny size: what is drawn, what is written,
what is refused.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.commands import adapt, adapt_policy
from openjax.errors import UserError
from openjax.learning import TrainSettings, build
from openjax.learning.gradient.adaptation import (
    LAG,
    Look,
    adapting_game,
    bounds_of,
    fine_tune,
    improves,
    make_adaptation,
    off_the_flight,
    starting_parameters,
)
from openjax.learning.settings import AdaptSettings, GeneratorSettings, MappoSettings
from openjax.policy import NetworkSettings, PolicyParameters, PredictorSettings
from openjax.pursuit import PursuitSettings
from openjax.store.policies import load_policy
from openjax.store.policy_files import save_policy_file
from openjax.vehicle import family
from openjax.vehicle.effects import save_effects
from openjax.vehicle.family import adapted_family

pytestmark = pytest.mark.slow

TINY = TrainSettings(
    environment=PursuitSettings(
        physics="stops", speed_limit="none", episode_length=8, observe_history=2, history_length=2
    ),
    network=NetworkSettings(features=8, heads=1),
    predictor=PredictorSettings(enabled=False),
    mappo=MappoSettings(minibatches=2),
    generator=GeneratorSettings(capacity=8, episodes_per_task=2),
    num_envs=8,
    rollout_length=4,
)


VALUES = {"motor_lag": {"extra_up": 0.04, "extra_down": 0.03}}
INTERVALS = {"motor_lag": {"extra_up": (0.035, 0.045)}}


@pytest.fixture
def policy_file(tmp_path):
    parts = build(TINY)

    def start(key):
        observation, _ = parts.environment.reset(key)
        return parts.policy.init(key, observation)

    path = tmp_path / "policy.npz"
    save_policy_file(path, jax.jit(start)(jax.random.key(1)), TINY)
    return path


def test_vehicles_are_drawn_from_the_intervals_and_a_share_of_all_else():
    drawn = {name: bounds for name, *bounds in adapted_family(VALUES, INTERVALS)}
    assert drawn["motor_lag.extra_up"][:2] == pytest.approx([0.035, 0.045])
    assert drawn["motor_lag.extra_down"][:2] == pytest.approx([0.027, 0.033])
    assert drawn["rotor_drag.d_xy"][:2] == pytest.approx([0.0, 0.35 * 0.015])
    assert drawn["yaw_torque.ratio"][:2] == pytest.approx([1 - 0.35 * 0.85, 1 + 0.35 * 0.1])
    assert drawn["ceiling_effect.strength"][:2] == [0.0, 0.0]
    assert bounds_of(VALUES, INTERVALS).shape == bounds_of({}, {}).shape


def test_the_game_is_as_vehicles_fly_whatever_the_policy_knew():
    game = adapting_game(PursuitSettings())
    assert (game.speed_limit, game.substeps, game.start_attitude) == ("none", 5, "drawn")
    assert (
        game.observe_history == 12 and adapting_game(PursuitSettings(time_step=0.04)).substeps == 20
    )


def test_only_what_is_clearly_better_is_kept():
    rng = np.random.default_rng(0)
    before = rng.normal(0.9, 0.3, 1000)  # episodes differ far more than policies do
    steps = rng.normal(200.0, 50.0, 1000)
    first = Look(before, steps)
    assert improves(first, Look(before + rng.normal(0.02, 0.1, 1000), steps))
    assert not improves(first, Look(before + rng.normal(0.0, 0.1, 1000), steps))
    assert not improves(first, Look(before - 0.02, steps))
    assert not improves(first, first)
    # sooner counts where nothing else gets worse
    sooner = steps - rng.normal(10.0, 50.0, 1000)
    assert improves(first, Look(before, sooner))
    assert not improves(first, Look(before - 0.001, sooner))


def test_the_best_step_on_the_way_is_kept():
    """A stand-in for training whose policy is its own step, and which is worth most
    after the third.
    """
    policy = PolicyParameters(actor=np.zeros(1), critic={}, predictor=np.zeros(1))
    settings = AdaptSettings(updates=6, look_every=1)

    def updates():
        for update in range(1, 7):
            yield policy.replace(actor=np.full(1, float(update))), {}

    def worth(parameters):
        score = -((float(parameters.actor[0]) - 3.0) ** 2)
        return Look(np.full(4, score), np.zeros(4))

    def worse_later(parameters):
        return Look(-parameters.actor, np.zeros(1))

    tuned = fine_tune(updates(), settings, policy, worth)
    assert tuned.update == 3 and tuned.parameters.actor[0] == 3.0 and len(tuned.looks) == 7
    worse = fine_tune(updates(), settings, policy, worse_later)
    assert worse.update == 0 and worse.parameters.actor[0] == 0.0


def test_what_is_won_back_is_the_share_of_a_loss_beyond_chance():
    chance = np.random.default_rng(0).normal(0.0, 0.1, 400)
    nominal = {name: np.ones(400) for name in adapt_policy.LOSSES}
    before = nominal | {"crash_rate": 1.5 + chance, "capture_step": 1.0 + chance - chance.mean()}
    after = nominal | {"crash_rate": 1.1 + chance}
    shares = adapt_policy.won_back({"nominal": nominal, "before": before, "after": after})
    assert shares["crash_rate"] == pytest.approx(0.8, abs=0.01)
    assert shares["capture_step"] is None and shares["collision_rate"] is None


def only(names, monkeypatch):
    """Effects by `names` are all there are: the others take long to compile."""
    family.vehicle_family(family.NOMINAL)  # read, checked and kept while there are all
    few = {name: family.known_effects()[name] for name in names}
    monkeypatch.setattr(family, "known_effects", lambda: few)


def test_moments_in_flight_are_the_nominal_vehicles_with_a_settled_other_one(
    policy_file, monkeypatch
):
    """A heavy vehicle at a moment of the light one's flight: where that is, with rotors
    that carry its own weight.
    """
    only(("mass", "state_latency"), monkeypatch)
    loaded = load_policy(policy_file)
    adaptation = make_adaptation(loaded.settings, AdaptSettings(worlds=2))
    parameters = starting_parameters(loaded.parameters, loaded.settings)
    bounds = bounds_of({"mass": {"extra": 0.008}}, {}, rest=0.0)
    fly = jax.jit(adaptation.nominal_flights)
    flights = fly(parameters, jax.random.key(0), bounds)
    nominal = fly(parameters, jax.random.key(0), bounds_of({}, {}, rest=0.0))
    own = flights.state.drones
    other = nominal.state.drones
    np.testing.assert_array_equal(own.position, other.position)
    np.testing.assert_array_equal(
        own.effect_memory["state_latency"]["pose"], other.effect_memory["state_latency"]["pose"]
    )
    np.testing.assert_array_equal(flights.position, nominal.position)
    np.testing.assert_allclose(flights.state.vehicles["mass"]["extra"], 0.008, atol=1e-3)
    np.testing.assert_array_equal(nominal.state.vehicles["mass"]["extra"], 0.0)
    assert not np.allclose(own.rotor_speed, other.rotor_speed)
    step = np.asarray(nominal.position)[LAG] - np.asarray(other.position)
    np.testing.assert_allclose(
        step, 0.01 * np.asarray(other.velocity), atol=2e-3
    )  # the flight that goes on from there


def test_a_flight_may_come_late_but_not_elsewhere():
    steps = np.random.default_rng(0).normal(0.0, 0.05, (LAG + 12, 1, 2, 3))
    flown = jnp.cumsum(jnp.asarray(steps, jnp.float32), axis=0)
    late = off_the_flight(flown[LAG - 4 : -4], flown[LAG - 4 : -4], flown, flown)
    np.testing.assert_allclose(late, 0.0, atol=1e-6)
    away = off_the_flight(flown[LAG:] + 0.1, flown[LAG:], flown, flown)
    assert (np.asarray(away) > 1.0).mean() > 0.9


def test_a_policy_is_fine_tuned_measured_and_written(policy_file, tmp_path, monkeypatch):
    only(("motor_lag", "mass"), monkeypatch)
    effects = tmp_path / "effects.toml"
    save_effects(effects, VALUES, INTERVALS)
    training = AdaptSettings(worlds=2, updates=1)
    command = adapt.AdaptCommand(
        effects, str(policy_file), tmp_path / "out", episodes=2, training=training
    )
    results = adapt_policy.adapt(command)
    assert json.loads((command.out / "adapt.json").read_text())["effects"] == ["motor_lag"]
    assert "motor_lag.extra_up" in (command.out / "adapt.html").read_text()
    before = load_policy(policy_file)
    after = load_policy(command.out / "policy.npz")
    assert dict((name, low) for name, low, *_ in after.settings.environment.vehicles)[
        "motor_lag.extra_up"
    ] == pytest.approx(0.035)
    changed = not np.allclose(
        *(jax.tree.leaves(loaded.parameters.actor)[0] for loaded in (before, after)), atol=1e-5
    )
    assert changed == results["kept"].startswith("fine-tuned")
    assert len(results["looks"]) == 2  # before and after its one step
    assert set(results["nominal"]) == set(adapt_policy.FIGURES) and set(results["won_back"]) == set(
        adapt_policy.LOSSES
    )
    with pytest.raises(UserError, match="already exists"):
        adapt.main([str(effects), "--policy", str(policy_file), "--out", str(command.out)])


def test_what_is_not_there_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        adapt.main([str(tmp_path / "nothing"), "--out", str(tmp_path / "out")])
    with pytest.raises(UserError, match="holds no flight log"):
        adapt.main([str(tmp_path), "--out", str(tmp_path / "out")])
    with pytest.raises(UserError, match="can't be written there"):
        adapt.main([str(tmp_path), "--out", "/proc/out"])
    with pytest.raises(UserError, match="episodes is 0; it must be a whole number in"):
        adapt.main([str(tmp_path), "--out", str(tmp_path / "out"), "--episodes", "0"])
    assert not (tmp_path / "out").exists()

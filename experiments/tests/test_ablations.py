"""The ablations' arithmetic: steps counted, savings, effects of the parts; runs that can't be compared are refused."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from experiments.paper import ablations, runs
from experiments.paper.runs import VARIANTS, by_variant, main_effects, read_run, savings, steps_to
from openjax.errors import UserError
from openjax.learning import GeneratorSettings, MappoSettings, TrainSettings, build, make_training_step
from openjax.learning.training_step import initial_carry
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings
from openjax.store.run_directory import create_run

TINY = TrainSettings(
    environment=PursuitSettings(episode_length=12, physics="rigid", history_length=3),
    network=NetworkSettings(features=8, heads=2),
    predictor=PredictorSettings(units=4, windows=2, steps=1, horizons=(1, 2)),
    mappo=MappoSettings(minibatches=2, epochs=1),
    generator=GeneratorSettings(capacity=8, episodes_per_task=2),
    num_envs=12,
    rollout_length=4,
)


def run_of(variant, seed, rates, layouts=None, length=10):
    """A run whose validation capture rate is `rates`, one evaluation every `length` steps."""
    curve = [
        {"steps": length * (i + 1), "seconds": 0.0, "capture_rate": r, "capture_step": 800 * (1 - r)}
        for i, r in enumerate(rates)
    ]
    row = {
        "episodes": 4,
        "capture_rate": 1.0,
        "capture_step": 100.0,
        "collision_rate": 0.0,
        "crash_rate": 0.0,
    }
    row |= layouts or {}
    return {
        "variant": variant,
        "seed": seed,
        "command": "train",
        "machine": None,
        "steps": curve[-1]["steps"],
        "settings": {"num_envs": 12, "total_steps": 100},
        "validation": curve,
        "layouts": [{"scenario": name, **row} for name in SCENARIOS],
    }


def test_a_training_step_simulates_exactly_the_steps_that_are_counted():
    """The generator flies no episodes of its own: the world's step is traced once, in a scan of the rollout's length
    over all worlds; any other use of it would be data that the curves leave out."""
    calls = []

    class Watched(Pursuit):
        def step(self, key, state, action):
            calls.append(key)
            return super().step(key, state, action)

    environment = Watched(TINY.environment)
    parts = build(TINY, environment)
    carry = jax.eval_shape(lambda key: initial_carry(TINY, parts, key), jax.random.key(0))
    jaxpr = jax.make_jaxpr(make_training_step(TINY, environment))(carry)
    assert len(calls) == 1
    lengths = [
        (eqn.params["length"], [v.aval.shape for v in eqn.outvars])
        for eqn in jaxpr.jaxpr.eqns
        if eqn.primitive.name == "scan"
    ]
    commands = (TINY.rollout_length, TINY.num_envs, TINY.environment.num_pursuers, 4)
    assert sum(length == TINY.rollout_length and commands in shapes for length, shapes in lengths) == 1
    assert TINY.steps_per_update == TINY.rollout_length * TINY.num_envs


def test_a_run_is_read_with_its_variant_and_refused_if_steps_are_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "fly", lambda policy, changes, episodes: [{"flown": episodes}])
    for number, (settings, variant) in enumerate(
        [
            (TINY, "OPEN"),
            (dataclasses.replace(TINY, generator=GeneratorSettings(enabled=False)), "MAPPO + predictor"),
            (dataclasses.replace(TINY, predictor=PredictorSettings(enabled=False)), "MAPPO + generator"),
        ]
    ):
        run = create_run(tmp_path / str(number), overwrite=False)
        run.write_settings(settings, {"command": "train", "machine": {}})
        evaluation = {
            "event": "validation",
            "update": 5,
            "steps": 240,
            "seconds": 1.0,
            "capture_rate": 0.5,
            "far_capture_rate": 0.25,
            "episode_return": 3.0,
        }
        (run.path / "metrics.jsonl").write_text(
            json.dumps({"event": "train"}) + "\n" + json.dumps(evaluation)
        )
        record = read_run(run.path, episodes=4)
        assert record["variant"] == variant and record["layouts"] == [{"flown": 4}]
        assert record["validation"] == [
            {"steps": 240, "seconds": 1.0, "capture_rate": 0.5, "far_capture_rate": 0.25}
        ]
    (run.path / "metrics.jsonl").write_text(json.dumps(evaluation | {"steps": 60}))
    with pytest.raises(UserError, match="60 steps after 5 updates of 48"):
        read_run(run.path, episodes=4)


def test_steps_to_a_rate_and_what_is_saved_against_mappo():
    fast, slow, never = [0.1, 0.96, 0.9, 1.0], [0.1, 0.2, 0.9, 0.97], [0.1, 0.2, 0.3, 0.4]
    assert steps_to(run_of("OPEN", 0, fast)["validation"], 0.95) == 20
    assert steps_to(run_of("OPEN", 0, never)["validation"], 0.95) is None
    runs = by_variant(
        [
            run_of("MAPPO", 0, slow),
            run_of("OPEN", 1, slow),
            run_of("OPEN", 0, fast),
            run_of("MAPPO + generator", 0, never),
        ]
    )
    assert list(runs) == ["OPEN", "MAPPO + generator", "MAPPO"] and [r["seed"] for r in runs["OPEN"]] == [
        0,
        1,
    ]
    rows = {name: (steps, text) for name, steps, text in savings(runs, "capture_rate", 0.95)}
    assert rows["OPEN"] == ([20, 40], "0.75 (0.50 to 1.00)")
    assert rows["MAPPO + generator"] == ([None], "≥ 1.00 (1.00 to 1.00)")
    assert rows["MAPPO"] == ([40], "–")


def test_runs_that_differ_in_more_than_the_switches_are_refused():
    other = run_of("MAPPO", 0, [1.0])
    other["settings"] = other["settings"] | {"total_steps": 50}
    with pytest.raises(UserError, match="differ in total_steps"):
        by_variant([run_of("OPEN", 0, [1.0]), other])
    with pytest.raises(UserError, match="a seed was given twice"):
        by_variant([run_of("OPEN", 0, [1.0]), run_of("OPEN", 0, [1.0])])
    flat = runs.common_settings(json.loads(json.dumps(dataclasses.asdict(TINY))))
    assert "num_envs" in flat and "predictor.units" in flat and "mappo.clip_epsilon" in flat
    assert not {"seed", "predictor.enabled", "generator.enabled", "generator.turn"} & set(flat)


def test_effects_of_the_parts_are_those_of_a_linear_model():
    """Against least squares with effect coding, and its standard error."""
    rng = np.random.default_rng(0)
    truth = {VARIANTS[0]: 10.0, VARIANTS[1]: 14.0, VARIANTS[2]: 11.0, VARIANTS[3]: 20.0}
    values, rows, runs = [], [], {}
    for name, generator, predictor in zip(VARIANTS[:4], (1, -1, 1, -1), (1, 1, -1, -1), strict=True):
        runs[name] = []
        for seed in range(3):
            values.append(truth[name] + rng.normal())
            rows.append([1, generator, predictor, generator * predictor])
            runs[name].append({"value": values[-1], "seed": seed})
    effects = main_effects(runs, lambda run: run["value"])
    design, values = np.array(rows, float), np.array(values)
    fitted, residual, *_ = np.linalg.lstsq(design, values, rcond=None)
    error = np.sqrt(residual[0] / 8 * np.linalg.inv(design.T @ design).diagonal())
    for i, name in enumerate(("generator", "predictor", "interaction"), start=1):
        assert effects[name][0] == pytest.approx(2 * fitted[i])
        assert effects[name][1] == pytest.approx(2 * 2.306 * error[i], rel=1e-3)
    assert main_effects(runs, lambda run: None) is None
    assert main_effects({"OPEN": runs["OPEN"]}, lambda run: run["value"]) is None


def test_the_page_and_figure_from_what_is_stored(tmp_path):
    rates = {"OPEN": 0.96, "MAPPO + predictor": 0.5, "MAPPO + generator": 0.97, "MAPPO": 0.9}
    records = [
        run_of(name, seed, [0.1, rate, 1.0], {"capture_rate": rate + 0.01 * seed})
        for name, rate in rates.items()
        for seed in (0, 1)
    ]
    out = tmp_path / "ablations"
    out.with_suffix(".json").write_text(
        json.dumps({"command": "c", "note": "", "commit": "abc", "runs": records}), encoding="utf-8"
    )
    ablations.main(["--out", str(out)])
    page = out.with_suffix(".md").read_text(encoding="utf-8")
    assert "| OPEN | 0, 0 | 0 | 0.67 (0.67 to 0.67) |" in page
    assert "| capture rate, the paper's four layouts | +0.2650 ± 0.0139 |" in page
    assert out.with_suffix(".png").stat().st_size > 10_000

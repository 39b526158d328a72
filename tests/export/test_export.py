"""Export: the file says what the policy says, for networks of both shapes, and refuses
what it can't say.
"""

import ctypes
import dataclasses
import json
import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.commands.export import EACH, ExportCommand, export, observations
from openjax.errors import UserError
from openjax.export.c_compiled import compile_c
from openjax.export.c_program import DrawnStrategies, c_program
from openjax.learning import TrainSettings
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Observation, Pursuit, PursuitSettings
from openjax.store.mixed_policies import Draws, mixed_policy
from openjax.store.policies import abstract_parameters, load_policy
from openjax.store.policy_files import save_policy_file


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory):
    """A small policy for teams with random weights, the predictor's not small, so that
    a mistake anywhere shows.
    """
    settings = TrainSettings(
        environment=PursuitSettings(
            team_sizes=(1, 3),
            history_pursuers="pooled",
            observe_position=True,
            observe_in="heading",
            observe_history=2,
            history_length=4,
        ),
        network=NetworkSettings(features=16, heads=2),
        predictor=PredictorSettings(units=8, horizons=(1, 5)),
    )
    environment = Pursuit(settings.environment)
    policy = Policy.for_environment(environment, settings.network, settings.predictor)
    leaves, structure = jax.tree.flatten(abstract_parameters(environment, policy))
    rng = np.random.default_rng(0)
    moved = [jnp.asarray(0.5 * rng.normal(size=leaf.shape), leaf.dtype) for leaf in leaves]
    path = tmp_path_factory.mktemp("policy") / "small.npz"
    save_policy_file(path, jax.tree.unflatten(structure, moved), settings, storage="float32")
    return path


@pytest.fixture(scope="module")
def flown(policy_file):
    """What the policy sees in games: several tests ask for the same, which takes
    seconds to compile.
    """
    return observations(load_policy(str(policy_file)), 64, 0)


NEEDS_CC = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")


@pytest.mark.parametrize("kind", ["onnx", "jax", pytest.param("c", marks=NEEDS_CC)])
def test_the_file_acts_as_the_policy_does(policy_file, flown, tmp_path, monkeypatch, kind):
    monkeypatch.setattr("openjax.commands.export.observations", lambda *_: dict(flown))
    if kind == "onnx":
        pytest.importorskip("onnxruntime", reason='the extra "export" is not installed')
    report = export(ExportCommand(str(policy_file), kind, out=tmp_path, observations=64))
    assert report["observations"] == 64
    assert report["largest_difference"] < 1e-5
    assert json.loads((tmp_path / f"{kind}.json").read_text())["output"]["action"] == [3, 4]
    assert (tmp_path / report["file"]).stat().st_size == report["bytes"]
    assert "privileged" not in report["inputs"] or kind == "jax"


@NEEDS_CC
def test_a_name_in_no_encoding_is_exported(policy_file, flown, tmp_path, monkeypatch):
    monkeypatch.setattr("openjax.commands.export.observations", lambda *_: dict(flown))
    odd = shutil.copyfile(policy_file, os.fsdecode(os.fsencode(tmp_path) + b"/policy_\xff.npz"))
    export(ExportCommand(str(odd), "c", out=tmp_path, observations=64))
    assert "policy_\\udcff.npz" in (tmp_path / "policy.c").read_text()


@NEEDS_CC
def test_the_c_program_is_one_vehicles_policy_for_any_observation(policy_file, flown):
    """Numbers that no game shows; a compiler that takes every warning for an error; a
    workspace full of NaN.
    """
    policy = load_policy(str(policy_file))
    rng = np.random.default_rng(1)
    seen = dict(flown)
    for name, values in flown.items():
        noise = rng.normal(size=values.shape)
        seen[name] = (noise > 0) if values.dtype == bool else noise.astype(np.float32)
    expected = np.asarray(jax.jit(jax.vmap(policy))(Observation(**seen)))[:, :1]
    own = {name: values[:, :1] if name in EACH else values for name, values in seen.items()}
    inputs = {
        name: jax.ShapeDtypeStruct(values.shape[1:], values.dtype) for name, values in own.items()
    }
    program = c_program(lambda **fields: policy(Observation(**fields)), inputs, "small", "A policy")
    assert np.ptp(expected, axis=0).min() > 0.01  # a thousand times what may differ
    np.testing.assert_allclose(compile_c(program, "small")(own), expected, atol=1e-5)
    assert "privileged" not in program.inputs
    assert program.workspace < 2000 and program.numbers < sum(
        leaf.size for leaf in jax.tree.leaves(policy.parameters)
    )


@pytest.fixture(scope="module")
def mixed_file(policy_file):
    """A team that draws one of two policies every 0.4 s."""
    member = load_policy(str(policy_file))
    scale = jax.tree.map(lambda leaf: 0.5 * leaf, member.parameters)
    both = mixed_policy([member, dataclasses.replace(member, parameters=scale)], Draws(0.4))
    path = policy_file.with_name("mixed.npz")
    save_policy_file(path, both.parameters, both.settings, storage="float32")
    return path


@pytest.mark.parametrize("kind", ["onnx", pytest.param("c", marks=NEEDS_CC)])
def test_who_draws_a_strategy_is_said(mixed_file, flown, tmp_path, monkeypatch, kind):
    if kind == "onnx":
        pytest.importorskip("onnxruntime", reason='the extra "export" is not installed')
    seen = flown | {"strategy": np.arange(64, dtype=np.int32) % 2}
    monkeypatch.setattr("openjax.commands.export.observations", lambda *_: seen)
    export(ExportCommand(str(mixed_file), kind, out=tmp_path, observations=64))
    said = json.loads((tmp_path / f"{kind}.json").read_text())
    assert "strategy" in said["inputs"] and "0 to 1" in said["strategy"]
    assert (said["strategies"], said["strategy_seconds"], said["strategy_steps"]) == (2, 0.4, 40)
    if kind == "c":
        header = (tmp_path / "policy.h").read_text()
        assert "equal odds" in header and "POLICY_STRATEGY_STEPS 40 " in header


@NEEDS_CC
@pytest.mark.parametrize("odds", [(), (1.0, 3.0, 2.0)])
def test_the_c_program_draws_by_the_odds_and_the_same_again(odds):
    kinds = {
        "x": jax.ShapeDtypeStruct((2,), jnp.float32),
        "strategy": jax.ShapeDtypeStruct((), jnp.int32),
    }
    program = c_program(
        lambda x, strategy: jnp.where(strategy == 0, x, -x),
        kinds,
        "draw",
        "A test",
        DrawnStrategies(3, 40, 0.4, odds),
    )
    compiled = compile_c(program, "draw")
    pointer = ctypes.byref(compiled.observation)

    def draws(seed, steps):
        """What is drawn in each of some steps."""
        out = []
        for step in steps:
            compiled.library.draw_draw_strategy(
                pointer, ctypes.c_uint32(seed), ctypes.c_uint32(step)
            )
            out.append(int(compiled.observation.strategy[0]))
        return out

    games = np.array([draws(seed, range(0, 40 * 30, 40)) for seed in range(100)])
    expected = 3000 * np.array(odds or (1.0, 1.0, 1.0)) / sum(odds or (1.0, 1.0, 1.0))
    drawn = np.bincount(games.ravel(), minlength=3)
    assert (np.abs(drawn - expected) < 5 * np.sqrt(expected)).all()
    # nor does one draw tell the next
    following = np.bincount((3 * games[:, :-1] + games[:, 1:]).ravel(), minlength=9)
    expected = 2900 * np.outer(expected, expected).ravel() / 3000**2
    assert (np.abs(following - expected) < 5 * np.sqrt(expected)).all()
    assert draws(7, range(0, 1200, 40)) == draws(7, range(39, 1239, 40)) == games[7].tolist()


def everything(x, flag):
    """Most of what the exports know."""
    table = jnp.arange(12.0).reshape(3, 4)
    y = jnp.einsum("ab,cb->ac", x, table) + jnp.pad(x[:, ::2], ((0, 0), (1, 0)))
    y = jnp.where(flag, jnp.stack([y, -y], 1).sum(1) + y, jnp.clip(y, -1.0, 2.0)) ** 3
    batched = jnp.einsum("ab,acd->abcd", y, jnp.stack([y.T @ y, 0.1 * table[:, :3]])).mean((1, 2))
    return (
        jax.lax.rsqrt(1.0 + jax.nn.softmax(y) ** 2)
        + jnp.concatenate([y[:, 1:], y[:, :1]], 1).T.max(0)[:, None]
        + jnp.tanh(batched)
    )


KINDS = {"x": jax.ShapeDtypeStruct((2, 4), jnp.float32), "flag": jax.ShapeDtypeStruct((2, 3), bool)}
X = np.random.default_rng(0).normal(size=(2, 4)).astype(np.float32)
FLAG = np.array([[True, False, True], [False, True, False]])


def test_operations_become_their_counterparts_in_onnx():
    onnxruntime = pytest.importorskip("onnxruntime", reason='the extra "export" is not installed')
    from openjax.export.onnx_graph import onnx_model

    model = onnx_model(everything, KINDS, "y")
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    found = session.run(None, {"x": X, "flag": FLAG})[0]
    np.testing.assert_allclose(found, everything(X, FLAG), rtol=2e-5, atol=2e-5)


@NEEDS_CC
def test_operations_become_their_counterparts_in_c():
    found = compile_c(c_program(everything, KINDS, "everything", "A test"), "everything")
    np.testing.assert_allclose(
        found({"x": X[None], "flag": FLAG[None]})[0], everything(X, FLAG), rtol=2e-5, atol=2e-5
    )


def test_what_has_no_counterpart_is_named():
    pytest.importorskip("onnx", reason='the extra "export" is not installed')
    from openjax.export.onnx_graph import onnx_model

    kinds = {"x": jax.ShapeDtypeStruct((3,), jnp.float32)}
    with pytest.raises(UserError, match="sort"):
        onnx_model(lambda x: jnp.sort(x), kinds, "y")
    with pytest.raises(UserError, match="sort"):
        c_program(lambda x: jnp.sort(x), kinds, "sorted", "A test")

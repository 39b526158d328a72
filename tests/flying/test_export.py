"""Export: the file says what the policy says, for networks of both shapes, and refuses what it can't say."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.export import Arguments, export
from openjax.learning import TrainSettings
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.store.policies import abstract_parameters
from openjax.store.policy_files import save_policy_file


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory):
    """A small policy with random weights, the predictor's not small, so that a mistake anywhere shows."""
    settings = TrainSettings(
        environment=PursuitSettings(observe_position=True, observe_history=2, history_length=4),
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


@pytest.mark.parametrize("kind", ["onnx", "jax"])
def test_the_file_acts_as_the_policy_does(policy_file, tmp_path, kind):
    if kind == "onnx":
        pytest.importorskip("onnxruntime", reason='the extra "export" is not installed')
    report = export(Arguments(str(policy_file), kind, tmp_path, observations=64))
    assert report["observations"] == 64
    assert report["largest_difference"] < 1e-5
    assert json.loads((tmp_path / f"{kind}.json").read_text())["output"]["action"] == [3, 4]
    assert (tmp_path / report["file"]).stat().st_size == report["bytes"]
    assert "privileged" not in report["inputs"] or kind == "jax"


def test_operations_become_their_counterparts():
    onnxruntime = pytest.importorskip("onnxruntime", reason='the extra "export" is not installed')
    from openjax.flying.onnx_graph import onnx_model

    table = jnp.arange(12.0).reshape(3, 4)

    def function(x, flag):
        y = jnp.einsum("ab,cb->ac", x, table) + jnp.pad(x[:, ::2], ((0, 0), (1, 0)))
        y = jnp.where(flag, jnp.stack([y, -y], 1).sum(1) + y, jnp.clip(y, -1.0, 2.0)) ** 3
        return (
            jax.lax.rsqrt(1.0 + jax.nn.softmax(y) ** 2)
            + jnp.concatenate([y[:, 1:], y[:, :1]], 1).T.max(0)[:, None]
        )

    kinds = {"x": jax.ShapeDtypeStruct((2, 4), jnp.float32), "flag": jax.ShapeDtypeStruct((2, 3), bool)}
    model = onnx_model(lambda x, flag: function(x, flag), kinds, "y")
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    x = np.random.default_rng(0).normal(size=(2, 4)).astype(np.float32)
    flag = np.array([[True, False, True], [False, True, False]])
    np.testing.assert_allclose(
        session.run(None, {"x": x, "flag": flag})[0], function(x, flag), rtol=2e-5, atol=2e-5
    )


def test_what_has_no_counterpart_is_named():
    pytest.importorskip("onnx", reason='the extra "export" is not installed')
    from openjax.flying.onnx_graph import onnx_model

    with pytest.raises(UserError, match="sort"):
        onnx_model(lambda x: jnp.sort(x), {"x": jax.ShapeDtypeStruct((3,), jnp.float32)}, "y")

"""Programs traced by an earlier process."""

import jax
import jax.numpy as jnp
import pytest
from flax import struct

from openjax.store.traced_programs import recall


@struct.dataclass
class Carry:
    key: jax.Array
    total: jax.Array


@pytest.fixture
def traces():
    return []


@pytest.fixture
def step(traces):
    @jax.jit
    def step(carry):
        traces.append(1)
        key, own = jax.random.split(carry.key)
        total = carry.total + jax.random.normal(own, carry.total.shape)
        return Carry(key, total), {"mean": jnp.mean(total)}, (total > 0,)

    return step


def outcome(function, carry):
    carry, metrics, (positive,) = jax.jit(function, donate_argnums=0)(carry)
    return (
        jax.random.key_data(carry.key).tolist(),
        carry.total.tolist(),
        float(metrics["mean"]),
        positive.tolist(),
    )


def test_what_was_traced_once_is_found_again_and_does_the_same(tmp_path, step, traces):
    def carry():
        return Carry(jax.random.key(3), jnp.arange(4.0))

    def of(made_from):
        return recall("step", step, lambda: (carry(),), carry(), made_from, tmp_path)

    expected = outcome(step, carry())
    before = len(traces)
    assert outcome(of("these settings"), carry()) == expected and len(traces) == before
    (file,) = tmp_path.iterdir()

    def never(carry):
        raise AssertionError("traced again")

    found = recall("step", jax.jit(never), lambda: (carry(),), carry(), "these settings", tmp_path)
    assert outcome(found, carry()) == expected
    with pytest.raises(AssertionError, match="traced again"):
        recall("step", jax.jit(never), lambda: (carry(),), carry(), "other settings", tmp_path)

    # a damaged file is traced and written anew
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert outcome(of("these settings"), carry()) == expected
    again = recall("step", jax.jit(never), lambda: (carry(),), carry(), "these settings", tmp_path)
    assert outcome(again, carry()) == expected and list(tmp_path.iterdir()) == [file]


def test_a_program_that_cannot_be_kept_is_used_as_it_is(tmp_path):
    @jax.jit
    def told(x):
        return jax.pure_callback(lambda x: x, x, x)

    assert (
        recall(
            "told", told, lambda: (jnp.zeros(2),), Carry(jnp.zeros(()), jnp.zeros(())), "", tmp_path
        )
        is told
    )
    assert not list(tmp_path.iterdir())

"""Checkpoints against damage: half-written, truncated, foreign, or of another shape."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.store.checkpoints import Checkpoints, abstract_like, load_arrays, load_state, place


def init():
    return {
        "actor": {"kernel": jnp.ones((3, 4))},
        "key": jax.random.split(jax.random.key(3), 2),
        "n": jnp.int32(0),
    }


def with_n(n):
    return place({**init(), "n": jnp.int32(n)})


@pytest.fixture
def run(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(1, with_n(1))
    checkpoints.save(2, with_n(2))
    checkpoints.wait()
    return checkpoints


def test_half_written_checkpoint_is_passed_over_and_removed(run):
    good = run.latest().path
    # What a kill in the middle of a write leaves behind: the temporary directory of the next one.
    unfinished = run.directory / "000000003.orbax-checkpoint-tmp"
    shutil.copytree(good, unfinished)
    (unfinished / "commit_success.txt").unlink(missing_ok=True)
    carry, record = run.restore_latest(abstract_like(place(init())))
    assert record.update == 2 and int(carry["n"]) == 2
    assert not unfinished.exists()


def test_damaged_checkpoint_falls_back_to_the_one_before(run):
    for file in (run.latest().path / "state" / "d").iterdir():
        file.write_bytes(file.read_bytes()[:3])
    warnings = []
    carry, record = run.restore_latest(abstract_like(place(init())), warnings.append)
    assert record.update == 1 and int(carry["n"]) == 1
    assert len(warnings) == 1 and "000000002" in warnings[0]


def test_other_shape_is_named(run):
    def other():
        return {**init(), "actor": {"kernel": jnp.ones((3, 5))}}

    with pytest.raises(UserError, match=r"actor/kernel is float32\[3, 4\] there, .* float32\[3, 5\]"):
        run.restore_latest(abstract_like(place(other())))


def test_foreign_directory_is_no_checkpoint(tmp_path):
    (tmp_path / "readme.txt").write_text("nothing here")
    with pytest.raises(UserError, match="is no checkpoint"):
        load_state(tmp_path, abstract_like(place(init())))
    with pytest.raises(UserError, match="holds no checkpoint"):
        Checkpoints(tmp_path).restore_latest(abstract_like(place(init())))


def test_part_of_a_tree_can_be_read_without_knowing_it(run):
    arrays = load_arrays(run.latest().path, "actor/")
    assert list(arrays) == ["actor/kernel"]
    np.testing.assert_array_equal(arrays["actor/kernel"], np.ones((3, 4)))

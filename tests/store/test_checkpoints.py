"""Checkpoints against damage: half-written, truncated, foreign, or of another shape."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.learning.train_state import policy_leaf
from openjax.store.checkpoint_files import is_checkpoint, load_arrays, load_state
from openjax.store.checkpoints import Checkpoints
from openjax.store.leaves import abstract_like, place


def init():
    return {
        "actor": {"kernel": jnp.ones((3, 4))},
        "key": jax.random.split(jax.random.key(3), 2),
        "n": jnp.int32(0),
    }


def only_n(name):
    return name if name == "n" else None


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
    # What a kill in the middle of a write leaves behind: the temporary directory of the
    # next one.
    unfinished = run.directory / "000000003.orbax-checkpoint-tmp"
    shutil.copytree(good, unfinished)
    (unfinished / "commit_success.txt").unlink(missing_ok=True)
    carry, record = run.restore_latest(abstract_like(place(init())))
    assert record.update == 2 and int(carry["n"]) == 2
    assert not unfinished.exists()


def test_any_changed_byte_is_found(run):
    """Flipped bits, cut ends and missing files, anywhere in the newest checkpoint, its
    checksums included.
    """
    rng = np.random.default_rng(0)
    kept = run.directory.with_name("kept")
    shutil.copytree(run.directory, kept)
    files = sorted(file for file in kept.rglob("*") if file.is_file() and "000000002" in str(file))
    abstract = abstract_like(place(init()))
    for number in range(2 * len(files)):
        shutil.rmtree(run.directory)
        shutil.copytree(kept, run.directory)
        damaged = run.directory / files[number % len(files)].relative_to(kept)
        content = bytearray(damaged.read_bytes())
        if not content:
            damaged.unlink()
        elif number % 3 == 0:
            damaged.write_bytes(content[: rng.integers(len(content))])
        else:
            content[rng.integers(len(content))] ^= 1 << rng.integers(8)
            damaged.write_bytes(content)
        again = Checkpoints(run.directory)
        warnings = []
        carry, record = again.restore_latest(abstract, warnings.append)
        assert record.update == 1 and int(carry["n"]) == 1, damaged
        told = is_checkpoint(
            run.directory / "000000002"
        )  # not where nothing says that it was finished
        assert ["000000002 is damaged" in text for text in warnings] == [True] * told, damaged
        assert again.load_best(only_n, lambda text: None)[1].update == 1


def test_a_damaged_best_checkpoint_gives_way_to_the_next_best(run):
    run.save(3, with_n(3), score=0.5)
    run.save(4, with_n(4), score=0.4)
    run.wait()
    assert run.best().update == 3
    file = max(run.best().path.rglob("*"), key=lambda file: file.is_file() and file.stat().st_size)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    warnings = []
    leaves, record = run.load_best(only_n, warnings.append)
    assert record.update == 4 and int(leaves["n"]) == 4
    assert len(warnings) == 1 and "000000003 is damaged" in warnings[0]


def test_other_shape_is_named(run):
    def other():
        return {**init(), "actor": {"kernel": jnp.ones((3, 5))}}

    with pytest.raises(
        UserError, match=r"actor/kernel is float32\[3, 4\] there, .* float32\[3, 5\]"
    ):
        run.restore_latest(abstract_like(place(other())))


def test_foreign_directory_is_no_checkpoint(tmp_path):
    (tmp_path / "readme.txt").write_text("nothing here")
    with pytest.raises(UserError, match="is no checkpoint"):
        load_state(tmp_path, abstract_like(place(init())))
    with pytest.raises(UserError, match="holds no checkpoint"):
        Checkpoints(tmp_path).restore_latest(abstract_like(place(init())))


def test_part_of_a_tree_can_be_read_without_knowing_it(run):
    kernel = {"actor/kernel": "mine"}
    arrays = load_arrays(run.latest().path, kernel.get)
    assert list(arrays) == ["mine"]
    np.testing.assert_array_equal(arrays["mine"], np.ones((3, 4)))


def test_the_policy_is_found_in_carries_of_now_and_of_before():
    names = {
        "actor/parameters/params/x/kernel": "actor/params/x/kernel",
        "predictor/parameters/y": "predictor/y",
        "policy/critic/params/x": "critic/params/x",
        "actor/optimiser/0/mu/params/x": None,
        "actor_optimiser/0/mu": None,
        "state/drones/position": None,
    }
    assert {name: policy_leaf(name) for name in names} == names

"""Damaged checkpoints of a tiny run: what is restored must be bit for bit what was
saved in it or in the one before.
"""

import random
import shutil
import tempfile
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import changed_bytes

TINY = """--preset quick --environment.time_step 0.01 --environment.substeps 1
    --environment.episode_length 20 --environment.physics rigid --environment.capture_radius 1.0
    --network.features 8 --network.heads 2 --predictor.units 4 --predictor.windows 2
    --predictor.horizons 1 2 --mappo.minibatches 2 --generator.capacity 8
    --generator.episodes_per_task 2 --num_envs 16 --rollout_length 10 --validation_episodes 2 --validation_interval 20
    --layout_episodes 1 --compare_with none --first_flights.updates 0""".split()


def make_checkpoints(folder: Path) -> None:
    """Two checkpoints of a tiny training carry in `folder`/checkpoints, and all their
    bits in `folder`/UPDATE.npz.
    """
    import jax

    from openjax.learning import make_start
    from openjax.store.checkpoints import Checkpoints
    from openjax.store.leaves import named_leaves, place

    checkpoints = Checkpoints(folder / "checkpoints")
    for update in (1, 2):
        carry = place(make_start(_tiny_settings())(jax.random.key(update)))
        np.savez(
            folder / f"{update}.npz",
            **{name: _plain(leaf) for name, leaf in named_leaves(carry).items()},
        )
        checkpoints.save(update, carry, score=float(update), notes={"seconds": 1.0})
    checkpoints.wait()


def _tiny_settings():
    from openjax.runs.request import read_command

    return read_command(TINY).settings


def try_damages(folder: Path, seeds: range) -> list[str]:
    """Damage the newest checkpoint (now and then either) and restore: `same`, `before`,
    `refused` or what went wrong.
    """
    import jax

    from openjax.errors import UserError
    from openjax.learning import make_start
    from openjax.learning.train_state import policy_leaf
    from openjax.store.checkpoints import Checkpoints
    from openjax.store.leaves import abstract_like, named_leaves

    saved = {update: dict(np.load(folder / f"{update}.npz")) for update in (1, 2)}
    abstract = abstract_like(jax.eval_shape(make_start(_tiny_settings()), jax.random.key(0)))
    outcomes = []
    for seed in seeds:
        rng = random.Random(f"damage {seed}")
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / "checkpoints"
            shutil.copytree(folder / "checkpoints", copy)
            files = sorted(path for path in copy.rglob("*") if path.is_file())
            newest = [path for path in files if "000000002" in str(path)]
            file = rng.choice(files if rng.random() < 0.1 else newest)
            before = file.read_bytes()
            if rng.random() < 0.1:
                file.unlink()
            else:
                file.write_bytes(changed_bytes(rng, before) if before else b"x")
            try:
                found = Checkpoints(copy)
                carry, record = found.restore_latest(abstract)
                leaves, best = found.load_best(
                    lambda name: name if policy_leaf(name) else None, lambda text: None
                )
                good = all(
                    _plain(leaf).tobytes() == saved[record.update][name].tobytes()
                    for name, leaf in named_leaves(carry).items()
                ) and all(
                    leaf.tobytes() == saved[best.update][name].tobytes()
                    for name, leaf in leaves.items()
                )
                outcomes.append(
                    "silently wrong" if not good else "same" if record.update == 2 else "before"
                )
            except UserError:
                outcomes.append("refused")
            except Exception as error:
                outcomes.append(f"traceback: {type(error).__name__}")
    return outcomes


def _plain(leaf):
    """A leaf as an array on the host, keys by their data."""
    import jax
    import jax.numpy as jnp

    return np.asarray(
        jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
    )

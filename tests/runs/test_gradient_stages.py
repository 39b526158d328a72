"""The first stage of a run stops when it is asked to, and keeps what was learnt until
then.
"""

import jax
import numpy as np
import pytest

from openjax.cluster.processes import Processes
from openjax.learning import make_start, preset
from openjax.runs.gradient_stages import TOGETHER, compile_first_flights
from openjax.runs.start import prepare
from openjax.runs.train_command import TrainCommand

SETTINGS = preset(
    "quick",
    environment=dict(num_pursuers=1, min_pillars=0, max_pillars=1),
    network=dict(features=8, heads=1),
    predictor=dict(enabled=False),
    first_flights=dict(updates=2 * TOGETHER),
    num_envs=40,
)


@pytest.mark.slow
def test_the_first_flights_stop_when_asked_to(tmp_path):
    command = TrainCommand(
        out=tmp_path / "run", devices="1", compare_with="none", settings=SETTINGS
    )
    job, _, _ = prepare(command, [], 0.0, Processes())
    fresh = make_start(SETTINGS)(jax.random.key(0)).policy
    said = []
    asked = iter([False, True])
    program = compile_first_flights(job, jax.eval_shape(lambda: fresh))
    learnt = program.learn(fresh, jax.random.key(1), said.append, lambda: next(asked))
    assert len(said) == 1 and said[0].startswith(f"{TOGETHER} of {2 * TOGETHER} updates, ")
    moved = [
        np.abs(np.asarray(new) - old).max()
        for new, old in zip(
            jax.tree.leaves(learnt.actor), jax.tree.leaves(fresh.actor), strict=True
        )
    ]
    assert 0.0 < max(moved) < 1.0
    assert learnt.critic is fresh.critic

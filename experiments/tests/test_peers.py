"""The study of peers leaves out what isn't installed, and its task can be recovered from."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.speed.recovery import HOLDS, SIZE, RecoveryEnv, controller, recover, see, tumble

BLOCK = """
import sys
for name in ("crazyflow", "hyperdrone", "jaxmarl", "brax", "rltools"):
    sys.modules[name] = None
sys.argv = ["peers", "--worlds", "2", "--steps", "2", "--learning_steps", "100", "--json", sys.argv[1]]
import runpy
runpy.run_module("experiments.speed.peers", run_name="__main__")
"""


def test_a_drone_is_held_where_it_hovers_at_the_goal():
    advance = jax.jit(recover)
    drone = jax.jit(tumble)(jax.random.key(0))
    assert jax.eval_shape(see, drone).shape == (SIZE,)
    assert not bool(advance(drone, jnp.zeros(4))[2])
    still = drone.replace(
        position=jnp.zeros(3), quaternion=jnp.array([1.0, 0, 0, 0]), body_rates=jnp.zeros(3)
    )
    _, reward, held = advance(still, jnp.zeros(4))
    assert bool(held) and reward > 0.9


def test_what_is_asked_of_learners_can_be_done():
    assert HOLDS + 0.05 < controller(64)["held"] < 0.5


def test_gymnasium_environment_ends_by_its_time():
    env = RecoveryEnv()
    env.reset(seed=0)
    ends = [env.step(np.zeros(4))[3] for _ in range(3)]
    assert ends == [False] * 3 and env.held == [0.0]


@pytest.mark.slow
def test_what_is_not_installed_is_left_out_with_a_line(tmp_path):
    file = tmp_path / "peers.json"
    done = subprocess.run(
        [sys.executable, "-c", BLOCK, str(file)], capture_output=True, text=True, check=True
    )
    assert done.stdout.count(": left out, ") == 6
    rows = json.loads(file.read_text())["rows"]
    assert {name.partition(",")[0] for name in rows} == {"openjax", "by hand"} and len(rows) == 5

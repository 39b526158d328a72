"""One device and four give the same training, on the same worlds; run in a process with virtual devices."""

import os
import subprocess
import sys

SCRIPT = """
import jax, numpy as np
from openjax.learning import TrainSettings, init_carry, preset
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.learning import GeneratorSettings, MappoSettings
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.runs.checkpoints import named_leaves, place
from openjax.runs.devices import carry_shardings, make_device_step
from openjax.runs.loop import guarded

settings = TrainSettings(
    environment=PursuitSettings(episode_length=10, physics="rigid", capture_radius=1.0),
    network=NetworkSettings(features=8, heads=2),
    predictor=PredictorSettings(units=4, windows=2, steps=1, horizons=(1, 2)),
    mappo=MappoSettings(minibatches=2, epochs=1),
    generator=GeneratorSettings(capacity=8, success_low=0.0, success_high=1.0, episodes_per_task=2),
    num_envs=16, rollout_length=10, total_steps=1000,
)
environment = Pursuit(settings.environment)
compilations = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, *_, **__: compilations.append(name) if "backend_compile" in name else None
)
start = init_carry(settings, jax.random.key(0), environment)
ends = []
for number in (1, 4):
    shardings = carry_shardings(number)
    step = guarded(make_device_step(settings, environment, number), shardings)
    carry = place(jax.tree.map(jax.numpy.copy, start), shardings)
    carry, metrics, broken = step(carry)
    before = len(compilations)
    for _ in range(2):
        carry, metrics, broken = step(carry)
    assert len(compilations) == before and not broken.any()
    assert len(carry.state.step.sharding.device_set) == number
    ends.append({name: leaf for name, leaf in named_leaves(carry).items() if name != "key"})
assert len(compilations) > 1 and int(ends[0]["archive/size"]) == 8
for name, leaf in ends[0].items():
    scale = 1e-3 * max(1.0, float(np.abs(np.asarray(leaf, np.float64)).max(initial=0.0)))
    np.testing.assert_allclose(leaf, ends[1][name], rtol=0, atol=scale, err_msg=name)
print("same")
"""


def test_four_devices_train_as_one():
    # Without optimisation, since compiling is what this test waits for.
    flags = "--xla_force_host_platform_device_count=4 --xla_backend_optimization_level=0"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "same" in done.stdout, done.stderr[-3000:]

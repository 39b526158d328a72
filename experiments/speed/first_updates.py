"""The first updates of a few small runs, bit for bit, and how large their programs are:
to show of a change of structure that it changes no number.

    python -m experiments.speed.first_updates before.json              # in one checkout
    python -m experiments.speed.first_updates after.json before.json   # in another: what differs

Leaves of the carry are compared as a multiset of checksums, so that they may change
their names.
"""

import hashlib
import sys
from pathlib import Path

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np

from openjax.files import read_json, write_json
from openjax.learning import TrainSettings, changed, make_start, make_training_step

SEEDS = 5
UPDATES = 2
SMALL = changed(
    TrainSettings(),
    environment=dict(episode_length=12, physics="rigid", history_length=3, capture_radius=1.0),
    network=dict(features=8, heads=2),
    predictor=dict(units=4, windows=2, horizons=(1, 2)),
    mappo=dict(minibatches=2, penalty_start=0.2),
    generator=dict(capacity=8, success_low=0.0, success_high=1.0, episodes_per_task=2),
    num_envs=24,
    rollout_length=4,
    total_steps=24 * 4 * 10,
)
REWARD = dict(first_capture=5.0, smoothness=2.0, crash=10.0, first_crash=9.0, lookahead=0.1)
RUNS = {
    "plain": SMALL,
    "evaders": changed(
        SMALL,
        environment=dict(
            evaders=("field", "greedy", "way_points", "learned", "learned"),
            reward=dict(margin=0.03, **REWARD),
            observe_in="heading",
            vehicles=(("motor_lag.extra_up", 0.0, 0.02, 0.0, 0.04),),
            rare_vehicles=0.5,
            observe_history=2,
        ),
        network=dict(shared_encoder=True),
        mappo=dict(step_subsampling=2, target_kl=0.01, clip_epsilon_end=0.05),
        evaders_start=0.1,
        evaders_ramp=0.1,
        restart_every=2,
        restart_steps=4,
        restart_close=0.5,
    ),
    "bare": changed(
        SMALL,
        environment=dict(speed_limit="none", substeps=2, physics="stops", reward=REWARD),
        network=dict(squash="sample"),
        predictor=dict(enabled=False),
        generator=dict(enabled=False),
        mappo=dict(actor_start=0.5),
    ),
}


def checksums(tree) -> list[str]:
    """One for each leaf, sorted."""
    sums = []
    for leaf in jax.tree.leaves(tree):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(leaf) if is_key else leaf)
        data = f"{array.dtype}{array.shape}".encode() + array.tobytes()
        sums.append(hashlib.sha256(data).hexdigest()[:16])
    return sorted(sums)


def equations(jaxpr) -> int:
    """How many a program has, those inside others too."""
    inside = [
        sub for equation in jaxpr.eqns for sub in jax.extend.core.jaxprs_in_params(equation.params)
    ]
    return len(jaxpr.eqns) + sum(map(equations, inside))


def first_updates(settings: TrainSettings) -> dict:
    """Checksums of the carry and the metrics after each seed's updates; the size of the
    step.
    """
    start = make_start(settings)
    step = make_training_step(settings)
    carry = jax.eval_shape(start, jax.random.key(0))
    record = {"equations": equations(jax.make_jaxpr(step)(carry).jaxpr)}
    record["operations"] = jax.jit(step).lower(carry).as_text().count(" = ")
    compiled = jax.jit(step)
    for seed in range(SEEDS):
        carry = start(jax.random.key(seed))
        record[f"seed {seed}, start"] = checksums(carry)
        for _ in range(UPDATES):
            carry, metrics = compiled(carry)
        record[f"seed {seed}, carry"] = checksums(carry)
        record[f"seed {seed}, metrics"] = {name: float(metrics[name]) for name in sorted(metrics)}
    return record


def main(file: str, before: str | None = None) -> int:
    """Write the record; with that of before, say what differs. Returns the exit
    status.
    """
    records = {}
    for name, settings in RUNS.items():
        records[name] = first_updates(settings)
        write_json(Path(file), records)
    if before is None:
        return 0
    earlier = read_json(Path(before))
    different = 0
    for name, record in records.items():
        for entry, value in record.items():
            same = value == earlier[name][entry]
            is_size = not entry.startswith("seed")
            different += not same and not is_size
            if is_size:
                print(f"{name}: {entry} {earlier[name][entry]} before, {value} now")
            elif not same:
                print(f"{name}: {entry} differs")
    print(f"{different} of {len(RUNS) * SEEDS * 3} records differ")
    return int(different > 0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

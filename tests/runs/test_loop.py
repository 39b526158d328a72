"""The host loop on a toy carry: exact resume, one compilation, stops on a NaN, a
signal, a time limit.
"""

import gc
import itertools
import json
import os
import signal
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from rich.console import Console

from openjax.interruption import StopRequest
from openjax.runs.loop import Loop, NotFiniteError, Plan, guarded
from openjax.show.metrics import Continuation, MetricsWriter, read_metrics
from openjax.show.progress import Progress
from openjax.store.checkpoint_files import is_checkpoint, load_arrays
from openjax.store.checkpoints import Checkpoints
from openjax.store.leaves import abstract_like, named_leaves, place


@struct.dataclass
class Carry:
    parameters: jax.Array
    momentum: jax.Array
    key: jax.Array
    update: jax.Array
    nothing: jax.Array


def init():
    return Carry(
        parameters=jnp.ones((4, 3)),
        momentum=jnp.zeros((4, 3)),
        key=jax.random.key(7),
        update=jnp.int32(0),
        nothing=jnp.zeros((0, 3)),
    )


def step(carry):
    key, draw = jax.random.split(carry.key)
    momentum = 0.9 * carry.momentum + jax.random.normal(draw, carry.parameters.shape)
    parameters = carry.parameters - 0.1 * momentum
    new = carry.replace(parameters=parameters, momentum=momentum, key=key, update=carry.update + 1)
    return new, {"loss": jnp.mean(parameters**2)}


def broken_step(carry):
    new, metrics = step(carry)
    bad = jnp.where(new.update >= 5, jnp.nan, 1.0)
    return new.replace(parameters=new.parameters * bad), metrics


@pytest.fixture(scope="module")
def compiled():
    return jax.jit(guarded(step), donate_argnums=0)


class Evaluation:
    """A function of the carry as what evaluates it."""

    def __init__(self, function, ready=True):
        self.function = function
        self.ready = ready

    def __call__(self, carry):
        return self.function(carry)

    def is_ready(self):
        return self.ready


def run(directory, compiled_step, updates, resume=False, evaluate=None, **options):
    checkpoints = options.pop("checkpoints", None) or Checkpoints(directory / "checkpoints")
    ready = options.pop("ready", True)
    first = 0
    if resume:
        carry, record = checkpoints.restore_latest(abstract_like(place(init())))
        first = record.update
    else:
        carry = place(init())
    metrics = MetricsWriter(
        directory, continuation=Continuation(first) if resume else None, tensorboard=False
    )
    plan = Plan(total_updates=updates, steps_per_update=10, **{"validation_interval": 4, **options})
    with Progress("toy", 10 * updates, Console(quiet=True)) as progress, StopRequest() as stop:
        try:
            loop = Loop(
                compiled_step,
                plan,
                checkpoints=checkpoints,
                metrics=metrics,
                progress=progress,
                directory=directory,
                stop=stop,
                evaluate=Evaluation(evaluate(stop), ready) if evaluate else None,
                first_update=first,
            )
            return loop.run(carry)
        finally:
            metrics.close()


def assert_same(a, b):
    for (name, x), (_, y) in zip(named_leaves(a).items(), named_leaves(b).items(), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x = jax.random.key_data(x)
            y = jax.random.key_data(y)
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y), err_msg=name)


@pytest.mark.parametrize("overlap", [False, True])
def test_resumed_run_equals_uninterrupted_run_and_compiles_once(tmp_path, compiled, overlap):
    whole = run(tmp_path / "whole", compiled, 12)
    run(tmp_path / "parts", compiled, 5, overlap=overlap)
    parts = run(tmp_path / "parts", compiled, 12, resume=True, overlap=overlap)
    assert_same(whole.carry, parts.carry)
    assert compiled._cache_size() == 1
    losses = [
        [r["loss"] for r in read_metrics(tmp_path / d / "metrics.jsonl")]
        for d in ("whole", "parts")
    ]
    assert losses[0] == losses[1]


def test_a_start_that_was_stopped_before_its_validation_ships_the_same_policy(tmp_path, compiled):
    """The start is the best there is; the run that was stopped finds that out when it
    is resumed.
    """

    def falling(stop):
        return lambda carry: (1.0 / (1.0 + float(carry.update)), {})

    plan = {"evaluate": falling, "validate_start": True}
    run(tmp_path / "whole", compiled, 8, **plan)
    run(tmp_path / "parts", compiled, 8, **plan, time_limit=0.0)
    assert Checkpoints(tmp_path / "parts" / "checkpoints").latest().score is None
    parts = run(tmp_path / "parts", compiled, 8, resume=True, **plan)
    records = [Checkpoints(tmp_path / name / "checkpoints").best() for name in ("whole", "parts")]
    assert [(record.update, record.score) for record in records] == [(0, 1.0)] * 2
    states = [load_arrays(record.path) for record in records]
    for name, array in states[0].items():
        np.testing.assert_array_equal(array, states[1][name], err_msg=name)
    assert parts.update == 8


def test_updates_are_saved_before_anybody_waits_for_the_validations_compiler(tmp_path, compiled):
    """A signal there ends the command at once; what was learnt goes on later, and is
    validated first.
    """
    checkpoints = Checkpoints(tmp_path / "checkpoints")

    def stopped(stop):
        def look(carry):
            raise KeyboardInterrupt

        return look

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, compiled, 8, evaluate=stopped, ready=False, checkpoints=checkpoints)
    checkpoints.abandon()
    assert (checkpoints.latest().update, checkpoints.latest().score) == (4, None)

    def score(stop):
        return lambda carry: (-float(carry.update), {})

    run(tmp_path, compiled, 8, resume=True, evaluate=score, validate_start=True)
    assert Checkpoints(tmp_path / "checkpoints").best().update == 4


def test_a_run_that_goes_on_keeps_its_validations_once(tmp_path):
    def validations():
        return [r["update"] for r in read_metrics(tmp_path / "metrics.jsonl", "validation")]

    def write(*updates, **options):
        writer = MetricsWriter(tmp_path, **options, tensorboard=False)
        for update in updates:
            writer.write("validation", update, 0, 0.0, {})
        writer.close()

    write(0, 4)
    write(continuation=Continuation(0))
    assert validations() == [0]
    write(0, 4, continuation=Continuation(0, drop_validation=True))
    assert validations() == [0, 4]


def test_best_and_last_checkpoints_are_kept(tmp_path, compiled):
    scores = iter([0.2, 0.9, 0.3, 0.4, 0.5])
    run(
        tmp_path,
        compiled,
        20,
        evaluate=lambda stop: lambda carry: (next(scores), {"capture_rate": 0.0}),
    )
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    assert [record.update for record in checkpoints.records()] == [8, 16, 20]
    assert checkpoints.best().update == 8


@pytest.mark.parametrize("overlap", [False, True])
def test_nan_stops_and_leaves_both_states(tmp_path, overlap):
    with pytest.raises(NotFiniteError, match=r"update 5 in parameters; .*000000004"):
        run(tmp_path, jax.jit(guarded(broken_step)), 20, overlap=overlap)
    assert Checkpoints(tmp_path / "checkpoints").latest().update == 4
    report = json.loads((tmp_path / "not_finite" / "report.json").read_text())
    assert report["update"] == 5 and report["leaves"] == ["parameters"]
    assert is_checkpoint(tmp_path / "not_finite" / f"{report['state_after_update']:09d}")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_saves_and_stops(tmp_path, compiled, number):
    def evaluate(stop):
        def kill_and_score(carry):
            os.kill(os.getpid(), number)
            return 0.0, {}

        return kill_and_score

    outcome = run(tmp_path, compiled, 1000, evaluate=evaluate, validation_interval=3)
    assert outcome.stopped_by == signal.Signals(number).name
    assert outcome.update < 10
    assert Checkpoints(tmp_path / "checkpoints").latest().update == outcome.update


def test_time_limit_stops(tmp_path, compiled):
    outcome = run(tmp_path, compiled, 10**6, time_limit=0.3)
    assert outcome.stopped_by == "the time limit"
    assert 0 < outcome.update < 10**6


def test_an_update_leaves_nothing_in_memory(compiled, tmp_path):
    """A process of half a gigabyte may grow by 5 % in a hundred thousand updates: 250
    bytes each.
    """
    seen = []

    def evaluate(stop):
        def look(carry):
            gc.collect()
            seen.append((tracemalloc.get_traced_memory()[0], len(jax.live_arrays())))
            return 0.0, {}

        return look

    tracemalloc.start()
    try:
        run(tmp_path, compiled, 1600, evaluate=evaluate, validation_interval=400)
    finally:
        tracemalloc.stop()
    sizes, arrays = zip(*seen[1:], strict=True)
    # a leak grows in every stretch, what others cache for good in one
    grown = min(after - before for before, after in itertools.pairwise(sizes))
    assert grown < 250 * 400 and len(set(arrays)) == 1

"""What was compiled ahead is found by the call, else every program would be compiled
twice.
"""

import threading
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from openjax.background import compile_ahead
from openjax.runs.loop import guarded
from openjax.store.leaves import abstract_like, place


def start():
    return {"x": jnp.arange(5.0), "key": jax.random.key(1), "n": jnp.zeros((), jnp.int32)}


def count(carry):
    return {**carry, "x": carry["x"] + 1.0, "n": carry["n"] + 1}, {"sum": jnp.sum(carry["x"])}


def test_call_finds_what_was_compiled_ahead():
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    step = jax.jit(guarded(count), donate_argnums=0, out_shardings=device)
    carry = place(start())
    compile_ahead(step, abstract_like(jax.eval_shape(start)))()
    compiled = []

    def listen(event, duration, **_):
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        carry, metrics, _ = step(carry)
        assert (int(carry["n"]), float(metrics["sum"]), compiled) == (1, 10.0, [])
        jax.jit(lambda x: x - 7.0)(carry["x"])
        assert compiled  # the listener hears a compilation
    finally:
        jax.monitoring.clear_event_listeners()


def test_what_goes_wrong_in_tracing_is_raised():
    with pytest.raises(AttributeError):
        compile_ahead(jax.jit(lambda x: x.nothing), jnp.zeros(3))


def test_what_goes_wrong_in_the_compiler_is_raised_when_waited_for():
    def fail():
        raise MemoryError("too large")

    wait = compile_ahead(SimpleNamespace(lower=lambda *_: SimpleNamespace(compile=fail)))
    with pytest.raises(MemoryError, match="too large"):
        wait()


def test_waits_no_longer_than_it_is_told():
    go_on = threading.Event()
    wait = compile_ahead(SimpleNamespace(lower=lambda *_: SimpleNamespace(compile=go_on.wait)))
    with pytest.raises(TimeoutError):
        wait(0.01)
    go_on.set()
    assert wait(60.0) and wait()

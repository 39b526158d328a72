"""What was compiled ahead is found by the call, else every program would be compiled twice."""

import jax
import jax.numpy as jnp

from openjax.runs.ahead import compile_ahead
from openjax.runs.checkpoints import abstract_like, place
from openjax.runs.loop import guarded


def start():
    return {"x": jnp.arange(5.0), "key": jax.random.key(1), "n": jnp.zeros((), jnp.int32)}


def count(carry):
    return {**carry, "x": carry["x"] + 1.0, "n": carry["n"] + 1}, {"sum": jnp.sum(carry["x"])}


def test_call_finds_what_was_compiled_ahead():
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    step = guarded(count, device, device)
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

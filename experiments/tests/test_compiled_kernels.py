"""Counting what the loops of a compiled program start."""

import sys

import pytest

from experiments.compiled_kernels import h200, loops, report
from openjax.errors import UserError

PROGRAM = """
%inner (a: (s32[], f32[4])) -> (s32[], f32[4]) {
  %b = f32[4]{0} fusion(%a), kind=kLoop, calls=%add
  %c = f32[4]{0} copy(%b)
  ROOT %t = (s32[], /*index=1*/f32[4]{0}) tuple(%i, %c)
}

%graph (a: f32[4]) -> f32[4] {
  %g = f32[4]{0} fusion(%a), kind=kLoop, calls=%add
  ROOT %h = f32[4]{0} fusion(%g), kind=kLoop, calls=%add
}

%outer (a: (s32[], f32[4])) -> (s32[], f32[4]) {
  %k = (f32[4]{0}, /*index=5*/f32[4]{0}) custom-call(%a), custom_call_target="kernel"
  %d = f32[4]{0} fusion(%k), kind=kLoop, calls=%add
  %e = f32[4]{0} call(%d), to_apply=%graph
  %w = (s32[], f32[4]{0}) while(%e), condition=%less, body=%inner, backend_config={"known_trip_count":{"n":"3"}}
  ROOT %t = (s32[], f32[4]{0}) tuple(%i, %w)
}

ENTRY %main (x: f32[4]) -> f32[4] {
  %f = f32[4]{0} fusion(%x), kind=kLoop, calls=%add
  ROOT %w = (s32[], f32[4]{0}) while(%f), condition=%less, body=%outer
}
"""


def test_each_loop_counts_its_own():
    assert sorted(loops(PROGRAM), key=lambda loop: loop["turns"] or 0) == [
        {"turns": None, "custom-call": 1, "fusion": 3},
        {"turns": 3, "fusion": 1, "copy": 1},
    ]


def test_page_adds_them_up():
    machine = {"device": "here", "versions": {"jax": "0"}, "commit": "abc"}
    lines = report({"command": "c", "machine": machine, "programs": {"p": loops(PROGRAM)}})
    assert {"| p | 3 | 1 | 0 | 1 | 2 |", "| p | None | 3 | 1 | 0 | 4 |"} <= set(lines)


def test_missing_compiler_is_named(monkeypatch):
    for plugin in ("jax_plugins.xla_cuda13", "jax_plugins.xla_cuda12"):
        monkeypatch.setitem(sys.modules, plugin, None)
    with pytest.raises(UserError, match="CUDA compiler is not installed"):
        h200()

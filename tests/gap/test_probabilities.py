"""Probabilities: they add up to one, the first word has the largest, and a name is as sure as its gain."""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap.library import Library
from openjax.gap.probabilities import NOTHING, SURE, probabilities_of
from openjax.gap.selection import Gain
from openjax.gap.shares import Share

SENSORS = SimpleNamespace(findings={})
QUIET = SimpleNamespace(strange=SimpleNamespace(predicted=np.zeros(6)), local=())


def said(effects, floors=None, offered=None, swaps=None, rest=QUIET, shares=None):
    gain = lambda f: Gain(nats=50.0, steady=40.0, floors=f, share=0.5)  # noqa: E731
    selection = SimpleNamespace(
        gains={e: gain(f) for e, f in (floors or {}).items()},
        offered={e: gain(f) for e, f in (offered or {}).items()},
        swaps=swaps or {},
    )
    one = lambda v: Share(v, (v, v))  # noqa: E731
    shares = shares or {e: 0.5 for e in effects}
    parts = SimpleNamespace(
        effects={e: one(v) for e, v in shares.items() if e != "unknown"},
        unexplained=one(shares.get("unknown", 0.0)),
        gap=SimpleNamespace(after=1.05),
    )
    evidence = SimpleNamespace(library=Library(), sensors=SENSORS)
    chance = probabilities_of(evidence, selection, parts, rest, effects)
    assert sum(chance.values()) == pytest.approx(1.0) and min(chance.values()) >= 0.0
    assert max(chance, key=chance.get) == (effects[0] if effects else "none")
    return chance


def test_a_name_is_as_sure_as_its_gain():
    weak, strong = (said(("wind",), {"wind": f})["wind"] for f in (0.05, 5.0))
    assert weak < 0.5 < 0.85 < strong < SURE


def test_the_first_word_stays_on_top_whatever_comes_near():
    chance = said(
        ("rotor_drag",), {"rotor_drag": 0.03}, offered={"wind": 0.5}, swaps={"rotor_drag": {"wind": 0.0}}
    )
    assert chance["wind"] == max(v for e, v in chance.items() if e != "rotor_drag")


def test_nothing_named_is_never_certain():
    assert said(())["none"] == pytest.approx(NOTHING)


def test_two_causes_share_and_a_pose_counts_as_sure():
    chance = said(("state_latency", "wind"), {"wind": 2.0}, shares={"state_latency": 0.6, "wind": 0.4})
    assert chance["state_latency"] > chance["wind"] > 0.1
